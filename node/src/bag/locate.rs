//! From the path a user gives to the files of the bag, in their order.

use std::cmp::Ordering;
use std::path::{Path, PathBuf};

use super::error::BagError;
use super::metadata::{METADATA_FILE, Metadata, resolve};
use super::problems::Problems;

/// The files of a bag and what metadata.yaml says about them.
#[derive(Debug, Default)]
pub(crate) struct Located {
    pub files: Vec<PathBuf>,
    pub metadata: Option<Metadata>,
}

/// Storage a file name promises.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Mcap,
    Sqlite,
}

fn kind(path: &Path) -> Option<Kind> {
    let name = path.file_name()?.to_str()?.to_ascii_lowercase();
    let name = name.strip_suffix(".zstd").unwrap_or(&name);
    if name.ends_with(".mcap") {
        Some(Kind::Mcap)
    } else if name.ends_with(".db3") {
        Some(Kind::Sqlite)
    } else {
        None
    }
}

/// Finds the files of the bag at `path`: the file itself, or those of a folder.
pub(crate) fn locate(path: &Path, problems: &Problems) -> Result<Located, BagError> {
    let found = std::fs::metadata(path).map_err(BagError::io(path))?;
    if found.is_file() {
        // A file named metadata.yaml stands for its folder, as it does for `ros2 bag`.
        if path.file_name().is_some_and(|n| n == METADATA_FILE) {
            let parent = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
            return locate_in_folder(parent, problems);
        }
        return Ok(Located { files: vec![path.to_owned()], metadata: None });
    }
    if found.is_dir() {
        return locate_in_folder(path, problems);
    }
    Err(BagError::NotABag { path: path.to_owned(), found: "neither a file nor a folder".to_owned() })
}

fn locate_in_folder(folder: &Path, problems: &Problems) -> Result<Located, BagError> {
    let present = bag_files(folder, problems)?;
    let metadata = match Metadata::read(folder) {
        Ok(m) => m,
        // Damaged metadata is worth a line, not the bag: the files speak for themselves.
        Err(e) if !present.is_empty() => {
            problems.add(format!("{e}; all bag files of the folder are read instead"));
            None
        }
        Err(e) => return Err(e),
    };
    let Some(metadata) = metadata else {
        return Ok(Located { files: one_storage(folder, present, "")?, metadata: None });
    };
    if let Some(format) = metadata.unknown_compression() {
        return Err(BagError::Compression { path: folder.to_owned(), found: format.to_owned() });
    }

    let mut files: Vec<PathBuf> = Vec::new();
    for relative in &metadata.relative_file_paths {
        match resolve(folder, relative) {
            Some(file) if files.contains(&file) => {}
            Some(file) => files.push(file),
            None => problems.add(format!("{METADATA_FILE} names `{relative}`, which is not in the folder: left out")),
        }
    }
    if files.is_empty() {
        let named = metadata.relative_file_paths.len();
        let files = one_storage(folder, present, &format!(" ({METADATA_FILE} names {named} files, none is there)"))?;
        problems.add(format!("{METADATA_FILE} names no file that is there; all bag files of the folder are read"));
        return Ok(Located { files, metadata: Some(metadata) });
    }
    for stray in present.iter().filter(|p| !files.contains(p)) {
        let unpacked_twin = files.iter().any(|f| same_but_for_zstd(f, stray));
        if !unpacked_twin {
            problems.add(format!("{} is not named by {METADATA_FILE}: left out", file_name(stray)));
        }
    }
    Ok(Located { files, metadata: Some(metadata) })
}

/// Bag files of a folder, naturally sorted; of a file and its `.zstd` twin only the unpacked one.
fn bag_files(folder: &Path, problems: &Problems) -> Result<Vec<PathBuf>, BagError> {
    let mut out = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(BagError::io(folder))? {
        let path = entry.map_err(BagError::io(folder))?.path();
        if kind(&path).is_some() && path.is_file() {
            out.push(path);
        }
    }
    out.sort_by(|a, b| natural_order(&file_name(a), &file_name(b)));
    let all = out.clone();
    out.retain(|p| {
        let twin = all.iter().any(|q| q != p && is_zstd(p) && same_but_for_zstd(p, q));
        if twin {
            problems.add(format!("{} is there unpacked as well: the unpacked file is read", file_name(p)));
        }
        !twin
    });
    Ok(out)
}

fn one_storage(folder: &Path, files: Vec<PathBuf>, why: &str) -> Result<Vec<PathBuf>, BagError> {
    let Some(first) = files.first() else {
        return Err(BagError::NoBagInFolder { path: folder.to_owned(), why: why.to_owned() });
    };
    match files.iter().find(|f| kind(f) != kind(first)) {
        None => Ok(files),
        Some(second) => {
            Err(BagError::MixedStorage { path: folder.to_owned(), first: file_name(first), second: file_name(second) })
        }
    }
}

fn is_zstd(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("zstd"))
}

fn same_but_for_zstd(a: &Path, b: &Path) -> bool {
    let stem = |p: &Path| if is_zstd(p) { p.with_extension("") } else { p.to_owned() };
    stem(a) == stem(b)
}

/// Last component of a path, for messages.
pub(crate) fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

/// Orders `bag_9` before `bag_10`: runs of digits compare as numbers, everything else byte by byte.
fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut a, mut b) = (a.as_bytes(), b.as_bytes());
    loop {
        let (na, nb) = (digits(a), digits(b));
        let step = if na > 0 && nb > 0 {
            // Leading zeros dropped, a longer number is a larger one.
            let (xa, xb) = (strip_zeros(&a[..na]), strip_zeros(&b[..nb]));
            let order = xa.len().cmp(&xb.len()).then_with(|| xa.cmp(xb)).then_with(|| na.cmp(&nb));
            (a, b) = (&a[na..], &b[nb..]);
            order
        } else {
            match (a.split_first(), b.split_first()) {
                (None, None) => return Ordering::Equal,
                (None, _) => return Ordering::Less,
                (_, None) => return Ordering::Greater,
                (Some((x, ra)), Some((y, rb))) => {
                    (a, b) = (ra, rb);
                    x.cmp(y)
                }
            }
        };
        if step != Ordering::Equal {
            return step;
        }
    }
}

fn digits(s: &[u8]) -> usize {
    s.iter().take_while(|c| c.is_ascii_digit()).count()
}

fn strip_zeros(s: &[u8]) -> &[u8] {
    let zeros = s.iter().take_while(|c| **c == b'0').count();
    &s[zeros..]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn touch(folder: &Path, names: &[&str]) {
        for n in names {
            std::fs::write(folder.join(n), b"x").unwrap();
        }
    }

    fn names(l: &Located) -> Vec<String> {
        l.files.iter().map(|f| file_name(f)).collect()
    }

    #[test]
    fn folders_without_metadata_sort_naturally_and_refuse_a_mixture() {
        let d = tempfile::tempdir().unwrap();
        let p = Problems::default();
        assert!(matches!(locate(d.path(), &p), Err(BagError::NoBagInFolder { .. })));
        touch(d.path(), &["b_10.mcap", "b_9.mcap", "b_1.mcap", "notes.txt"]);
        assert_eq!(names(&locate(d.path(), &p).unwrap()), ["b_1.mcap", "b_9.mcap", "b_10.mcap"]);
        touch(d.path(), &["x.db3"]);
        assert!(matches!(locate(d.path(), &p), Err(BagError::MixedStorage { .. })));
        assert!(matches!(locate(&d.path().join("nowhere"), &p), Err(BagError::Io { .. })));
    }

    #[test]
    fn metadata_decides_and_says_what_is_missing_or_stray() {
        let d = tempfile::tempdir().unwrap();
        touch(d.path(), &["a_0.db3", "a_1.db3.zstd", "a_1.db3", "other.mcap"]);
        let yaml = "rosbag2_bagfile_information: {relative_file_paths: [bag/a_0.db3, a_1.db3.zstd, a_2.db3]}";
        touch(d.path(), &[METADATA_FILE]);
        std::fs::write(d.path().join(METADATA_FILE), yaml).unwrap();
        let p = Problems::default();
        assert_eq!(names(&locate(d.path(), &p).unwrap()), ["a_0.db3", "a_1.db3.zstd"]);
        let lines = p.lines().join("\n");
        assert!(lines.contains("`a_2.db3`") && lines.contains("other.mcap is not named"), "{lines}");
        let l = locate(&d.path().join(METADATA_FILE), &p).unwrap();
        assert_eq!(names(&l), ["a_0.db3", "a_1.db3.zstd"]);
    }

    #[test]
    fn unknown_compression_is_refused_by_name() {
        let d = tempfile::tempdir().unwrap();
        touch(d.path(), &["a.db3"]);
        let yaml = "rosbag2_bagfile_information: {compression_format: brotli, compression_mode: FILE}";
        std::fs::write(d.path().join(METADATA_FILE), yaml).unwrap();
        let e = locate(d.path(), &Problems::default()).unwrap_err().to_string();
        assert!(e.contains("brotli"), "{e}");
    }

    proptest! {
        #[test]
        fn natural_order_is_a_total_order(a in "[a0-9]{0,6}", b in "[a0-9]{0,6}", c in "[a0-9]{0,6}") {
            prop_assert_eq!(natural_order(&a, &b), natural_order(&b, &a).reverse());
            prop_assert_eq!(natural_order(&a, &b) == Ordering::Equal, a == b);
            if natural_order(&a, &b) == Ordering::Less && natural_order(&b, &c) == Ordering::Less {
                prop_assert_eq!(natural_order(&a, &c), Ordering::Less);
            }
        }
    }
}
