//! Files that are either whole or absent: written beside their place under a temporary name, then renamed.

use std::ffi::OsString;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use super::OutputError;

/// The temporary name beside `path`.
fn part_path(path: &Path) -> PathBuf {
    let mut name: OsString = path.file_name().map(OsString::from).unwrap_or_default();
    name.push(format!(".{}.part", std::process::id()));
    path.with_file_name(name)
}

/// Writes `path` through `fill`; on any error the old file (if there was one) stays and the temporary one goes.
pub fn write_atomic(
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<File>) -> Result<(), OutputError>,
) -> Result<(), OutputError> {
    write(path, false, fill)
}

/// `sync`: the file is on the disk itself before it gets its name.
fn write(
    path: &Path,
    sync: bool,
    fill: impl FnOnce(&mut BufWriter<File>) -> Result<(), OutputError>,
) -> Result<(), OutputError> {
    let part = part_path(path);
    let result = (|| {
        let mut out = BufWriter::new(File::create(&part).map_err(OutputError::io(&part))?);
        fill(&mut out)?;
        out.flush().map_err(OutputError::io(&part))?;
        if sync {
            out.get_ref().sync_data().map_err(OutputError::io(&part))?;
        }
        drop(out);
        std::fs::rename(&part, path).map_err(OutputError::io(path))
    })();
    if result.is_err() {
        // The first error is the one worth telling; a leftover that cannot be removed adds nothing to it.
        let _ = std::fs::remove_file(&part);
    }
    result
}

/// Waits until files and their names are on the disk itself, so that a machine that loses its power keeps them. `paths` are
/// of one folder, `dir`.
///
/// # Errors
/// A file that cannot be opened or that the disk does not take.
pub fn sync_files(dir: &Path, paths: impl IntoIterator<Item = impl AsRef<Path>>) -> Result<(), OutputError> {
    for path in paths {
        let path = path.as_ref();
        match File::open(path) {
            Ok(file) => file.sync_data().map_err(OutputError::io(path))?,
            // Replaced or given up meanwhile: nobody will miss it.
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => {}
            Err(e) => return Err(OutputError::io(path)(e)),
        }
    }
    // Names live in the folder. Windows has no such call and keeps names by itself.
    if cfg!(unix) {
        File::open(dir).and_then(|d| d.sync_all()).map_err(OutputError::io(dir))?;
    }
    Ok(())
}

/// Writes `bytes` to `path`, whole or not at all.
pub fn write_bytes(path: &Path, bytes: &[u8]) -> Result<(), OutputError> {
    write_atomic(path, |out| out.write_all(bytes).map_err(OutputError::io(path)))
}

/// The same, and on the disk itself when it returns: the old file or the new one outlives a loss of power.
pub fn write_bytes_synced(path: &Path, bytes: &[u8]) -> Result<(), OutputError> {
    write(path, true, |out| out.write_all(bytes).map_err(OutputError::io(path)))?;
    match path.parent() {
        Some(dir) => sync_files(dir, [] as [&Path; 0]),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_write_leaves_the_old_file_and_nothing_else() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.txt");
        write_bytes(&path, b"old").unwrap();
        let failed = write_atomic(&path, |out| {
            out.write_all(b"half").unwrap();
            Err(OutputError::UnknownTopic(3))
        });
        assert!(failed.is_err());
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
        write_bytes(&path, b"new").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"new");
    }

    #[test]
    fn syncing_passes_over_what_is_gone() {
        let dir = tempfile::tempdir().unwrap();
        let (here, gone) = (dir.path().join("a"), dir.path().join("b"));
        write_bytes(&here, b"x").unwrap();
        sync_files(dir.path(), [here.as_path(), gone.as_path()]).unwrap();
        write_bytes_synced(&here, b"y").unwrap();
        assert_eq!(std::fs::read(&here).unwrap(), b"y");
        assert!(sync_files(&gone, [] as [&Path; 0]).is_err() || !cfg!(unix));
    }

    #[test]
    fn a_missing_folder_is_named_in_the_error() {
        let dir = tempfile::tempdir().unwrap();
        let error = write_bytes(&dir.path().join("none").join("a.txt"), b"x").unwrap_err();
        assert!(error.to_string().contains("none"), "{error}");
    }
}
