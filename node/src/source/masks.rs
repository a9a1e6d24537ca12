//! `input.masks`: pictures that say which part of a camera's images to ignore, and the validity mask of a camera altogether.

use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::decode::{BlackFrame, Rectifier, RgbPicture, Validity, sampled_mask};

/// Largest side of a mask picture, pixels: as of a camera's.
const MAX_SIDE: u32 = 16_384;

/// What is wrong with a mask.
#[derive(Debug, Error)]
pub enum MaskError {
    /// An entry that is not `CAMERA=FILE`.
    #[error("input.masks: `{0}` is not CAMERA=FILE, with the camera's number or image topic")]
    Entry(String),
    /// An entry for a camera there is not.
    #[error("input.masks: `{entry}` names no camera; there are {cameras}")]
    Camera {
        /// The entry.
        entry: String,
        /// Numbers and topics of the cameras there are.
        cameras: String,
    },
    /// Two entries for one camera.
    #[error("input.masks: camera {0} has two masks; put both into one picture")]
    Twice(usize),
    /// A picture that cannot be read.
    #[error("input.masks: cannot read {}: {why}", path.display())]
    Read {
        /// The picture.
        path: PathBuf,
        /// Why.
        why: String,
    },
    /// Nothing is left of a camera's images.
    #[error("camera {camera} ({topic}): {what} leave nothing of its images")]
    NothingLeft {
        /// Camera index.
        camera: usize,
        /// Image topic.
        topic: String,
        /// What was left out.
        what: String,
    },
}

/// The mask pictures, by camera.
pub struct Masks(Vec<Option<(PathBuf, RgbPicture)>>);

/// Camera and file of an entry.
pub fn parse(entry: &str) -> Result<(&str, &str), MaskError> {
    match entry.split_once('=') {
        Some((camera, file)) if !camera.trim().is_empty() && !file.trim().is_empty() => {
            Ok((camera.trim(), file.trim()))
        }
        _ => Err(MaskError::Entry(entry.to_owned())),
    }
}

impl Masks {
    /// Reads the pictures that the entries `CAMERA=FILE` name; `topics` are the cameras' image topics in order.
    pub fn read(entries: &[String], topics: &[&str]) -> Result<Self, MaskError> {
        let mut masks: Vec<Option<(PathBuf, RgbPicture)>> = topics.iter().map(|_| None).collect();
        for entry in entries {
            let (name, file) = parse(entry)?;
            let number = name.parse::<usize>().ok().filter(|&i| i < topics.len());
            let Some(camera) = topics.iter().position(|topic| *topic == name).or(number) else {
                let known: Vec<String> = topics.iter().enumerate().map(|(i, topic)| format!("{i} ({topic})")).collect();
                return Err(MaskError::Camera { entry: entry.clone(), cameras: known.join(", ") });
            };
            if masks[camera].is_some() {
                return Err(MaskError::Twice(camera));
            }
            masks[camera] = Some((PathBuf::from(file), picture(Path::new(file))?));
        }
        Ok(Self(masks))
    }

    /// Which pixels of a camera's network images show something: all that rectification, its black frame and its mask leave.
    /// None: all do.
    pub fn validity(
        &self,
        camera: usize,
        topic: &str,
        rectifier: &Rectifier,
        black_frame: Option<&BlackFrame>,
    ) -> Result<Option<Validity>, MaskError> {
        let mut what = vec!["pixels outside of the sensor".to_owned()];
        let mut valid = rectifier.inside();
        let mut and = |name: String, source: Vec<bool>| {
            what.push(name);
            valid.iter_mut().zip(rectifier.carry(&source)).for_each(|(valid, shown)| *valid &= shown);
        };
        if let Some(frame) = black_frame.filter(|frame| frame.size == rectifier.source_size()) {
            and("its black frame".to_owned(), frame.valid());
        }
        if let Some(Some((path, mask))) = self.0.get(camera) {
            and(format!("the mask {}", path.display()), sampled_mask(mask, rectifier.source_size()));
        }
        let nothing_left = |_| MaskError::NothingLeft { camera, topic: topic.to_owned(), what: what.join(", ") };
        Validity::new(valid, rectifier.intrinsics().width).map_err(nothing_left)
    }
}

fn picture(path: &Path) -> Result<RgbPicture, MaskError> {
    let failed = |why: String| MaskError::Read { path: path.to_owned(), why };
    let mut reader = image::ImageReader::open(path)
        .and_then(image::ImageReader::with_guessed_format)
        .map_err(|e| failed(e.to_string()))?;
    let mut limits = image::Limits::default();
    (limits.max_image_width, limits.max_image_height) = (Some(MAX_SIDE), Some(MAX_SIDE));
    reader.limits(limits);
    let rgba = reader.decode().map_err(|e| failed(e.to_string()))?.to_rgba8();
    let (width, height) = (rgba.width() as usize, rgba.height() as usize);
    if width == 0 || height == 0 {
        return Err(failed("it has no pixels".to_owned()));
    }
    let data = rgba.pixels().flat_map(|p| [p[0], p[1], p[2]]).collect();
    Ok(RgbPicture { width, height, data })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::msg::{CameraInfo, Header};

    const TOPICS: [&str; 2] = ["/left/image", "/right/image"];

    fn write(dir: &Path, name: &str, pixels: &[u8], width: u32) -> String {
        let path = dir.join(name);
        let height = pixels.len() as u32 / width;
        image::GrayImage::from_raw(width, height, pixels.to_vec()).unwrap().save(&path).unwrap();
        path.display().to_string()
    }

    fn rectifier() -> Rectifier {
        let k = storm_render::Intrinsics { fx: 8.0, fy: 8.0, cx: 4.0, cy: 4.0, width: 8, height: 8 };
        let info = CameraInfo::pinhole(&k, Header { stamp_ns: 0, frame_id: "cam".into() });
        Rectifier::new(&info, true, 4, 4).unwrap()
    }

    #[test]
    fn masks_are_found_by_topic_and_number_and_only_their_camera_is_masked() {
        let dir = tempfile::tempdir().unwrap();
        let file = write(dir.path(), "ego.png", &[255, 255, 0, 0], 1);
        for entry in [format!("/right/image={file}"), format!("1 = {file}")] {
            let masks = Masks::read(&[entry], &TOPICS).unwrap();
            assert!(masks.validity(0, TOPICS[0], &rectifier(), None).unwrap().is_none());
            let validity = masks.validity(1, TOPICS[1], &rectifier(), None).unwrap().unwrap();
            assert!((0..16).all(|i| validity.valid()[i] == (i < 8)), "{:?}", validity.valid());
        }
    }

    #[test]
    fn a_black_frame_hides_every_pixel_it_darkens() {
        // The first row of eight is half of the first row of four.
        let frame =
            BlackFrame { size: (8, 8), rows_and_columns: [1, 0, 0, 0], black: (0..64).map(|i| i < 8).collect() };
        let masks = Masks::read(&[], &TOPICS).unwrap();
        let validity = masks.validity(0, TOPICS[0], &rectifier(), Some(&frame)).unwrap().unwrap();
        assert!((0..16).all(|i| validity.valid()[i] == (i >= 4)));
        let other = BlackFrame { size: (4, 16), ..frame };
        assert!(masks.validity(0, TOPICS[0], &rectifier(), Some(&other)).unwrap().is_none());
    }

    #[test]
    fn what_cannot_be_used_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let file = write(dir.path(), "ego.png", &[0, 0], 1);
        let says = |entries: &[String], text: &str| {
            let e = Masks::read(entries, &TOPICS).err().unwrap().to_string();
            assert!(e.contains(text), "{e} should say {text}");
        };
        says(&["ego.png".into()], "`ego.png` is not CAMERA=FILE");
        says(&["0=".into()], "`0=` is not");
        says(&[format!("/front={file}")], "0 (/left/image), 1 (/right/image)");
        says(&[format!("2={file}")], "names no camera");
        says(&["0=nowhere.png".into()], "cannot read nowhere.png");
        says(&[format!("0={file}"), format!("/left/image={file}")], "two masks");
        let text = dir.path().join("text.png");
        std::fs::write(&text, "no picture").unwrap();
        says(&[format!("0={}", text.display())], "cannot read");
        let all = Masks::read(&[format!("0={file}")], &TOPICS).unwrap();
        let e = all.validity(0, TOPICS[0], &rectifier(), None).unwrap_err().to_string();
        assert!(e.contains("camera 0 (/left/image)") && e.contains("ego.png leave nothing"), "{e}");
    }
}
