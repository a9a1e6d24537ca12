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
    let part = part_path(path);
    let result = (|| {
        let mut out = BufWriter::new(File::create(&part).map_err(OutputError::io(&part))?);
        fill(&mut out)?;
        out.flush().map_err(OutputError::io(&part))?;
        drop(out);
        std::fs::rename(&part, path).map_err(OutputError::io(path))
    })();
    if result.is_err() {
        // The first error is the one worth telling; a leftover that cannot be removed adds nothing to it.
        let _ = std::fs::remove_file(&part);
    }
    result
}

/// Writes `bytes` to `path`, whole or not at all.
pub fn write_bytes(path: &Path, bytes: &[u8]) -> Result<(), OutputError> {
    write_atomic(path, |out| out.write_all(bytes).map_err(OutputError::io(path)))
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
    fn a_missing_folder_is_named_in_the_error() {
        let dir = tempfile::tempdir().unwrap();
        let error = write_bytes(&dir.path().join("none").join("a.txt"), b"x").unwrap_err();
        assert!(error.to_string().contains("none"), "{error}");
    }
}
