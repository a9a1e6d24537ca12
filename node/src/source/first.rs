//! The first pictures of a recording's cameras, decoded before anything is run: a topic that cannot be decoded ends the run
//! here and not after the whole bag.

use anyhow::{Result, anyhow};

use crate::cdr::decode as cdr;
use crate::decode::{self, DecodeError};
use crate::pipeline::guard::caught;

use super::topics::CameraTopics;

/// Pictures of a camera that may be damaged before its topic is given up.
const TRIES: usize = 5;

/// What is known of one camera's pictures.
#[derive(Debug, Clone, Default)]
struct Tried {
    decoded: bool,
    failed: usize,
    first_failure: String,
}

/// Tries pictures of each camera until one can be decoded.
pub struct FirstPictures(Vec<Tried>);

impl FirstPictures {
    /// Of so many cameras.
    pub fn new(cameras: usize) -> Self {
        Self(vec![Tried::default(); cameras])
    }

    /// True once every camera gave a picture.
    pub fn done(&self) -> bool {
        self.0.iter().all(|t| t.decoded)
    }

    /// A message of camera number `camera`.
    ///
    /// # Errors
    /// An encoding that is not decoded, or the last of the first pictures that are all damaged.
    pub fn take(&mut self, camera: usize, topics: &CameraTopics, data: &[u8]) -> Result<()> {
        let Some(tried) = self.0.get_mut(camera).filter(|t| !t.decoded) else { return Ok(()) };
        let why = match caught(|| try_picture(topics.compressed, data)) {
            Ok(Ok(())) => {
                tried.decoded = true;
                return Ok(());
            }
            Ok(Err(Failure::Never(e))) => return Err(anyhow!("{}: {e}", topics.name)),
            Ok(Err(Failure::Damaged(why))) => why,
            Err(panic) => format!("its decoder panicked ({panic}); this is a fault of the program"),
        };
        tried.failed += 1;
        if tried.first_failure.is_empty() {
            tried.first_failure = why;
        }
        if tried.failed == TRIES { Err(tried.given_up(&topics.name)) } else { Ok(()) }
    }

    /// At the end of a recording.
    ///
    /// # Errors
    /// A camera all of whose pictures are damaged.
    pub fn finish(&self, cameras: &[CameraTopics]) -> Result<()> {
        let lost = self.0.iter().zip(cameras).find(|(t, _)| !t.decoded && t.failed > 0);
        lost.map_or(Ok(()), |(t, c)| Err(t.given_up(&c.name)))
    }
}

impl Tried {
    fn given_up(&self, topic: &str) -> anyhow::Error {
        anyhow!("{topic}: none of its first {} pictures can be decoded; the first: {}", self.failed, self.first_failure)
    }
}

enum Failure {
    /// Later pictures of the topic will fail alike.
    Never(DecodeError),
    Damaged(String),
}

fn try_picture(compressed: bool, data: &[u8]) -> Result<(), Failure> {
    let unread = |e: crate::cdr::CdrError| Failure::Damaged(e.to_string());
    let decoded = if compressed {
        decode::compressed_to_rgb(&cdr::compressed_image(data).map_err(unread)?)
    } else {
        decode::image_to_rgb(&cdr::image(data).map_err(unread)?)
    };
    decoded.map(|_| ()).map_err(|e| match e {
        DecodeError::Encoding { .. } => Failure::Never(e),
        damaged => Failure::Damaged(damaged.to_string()),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cdr::encode::encode_image;
    use crate::msg::Image;

    /// One row of 6 bytes, said to be `width` pixels wide.
    fn message(encoding: &str, width: u32) -> Vec<u8> {
        let data = vec![1; 6];
        encode_image(&Image { encoding: encoding.into(), width, height: 1, step: 6, data, ..Image::default() }).unwrap()
    }

    #[test]
    fn an_unknown_encoding_ends_it_at_once_and_damage_after_a_few() {
        let camera = CameraTopics { image: 0, name: "/cam/image".into(), compressed: false, info: 1 };
        let mut first = FirstPictures::new(1);
        let e = first.take(0, &camera, &message("nv99", 2)).unwrap_err().to_string();
        assert!(e.contains("/cam/image") && e.contains("nv99") && e.contains("rgb8"), "{e}");

        let mut first = FirstPictures::new(1);
        first.take(0, &camera, &message("rgb8", 3)).unwrap();
        first.take(0, &camera, &[0, 1, 0, 0]).unwrap();
        assert!(!first.done());
        let e = first.finish(std::slice::from_ref(&camera)).unwrap_err().to_string();
        assert!(e.contains("first 2 pictures") && e.contains("a row takes 9 bytes"), "{e}");
        first.take(0, &camera, &message("rgb8", 2)).unwrap();
        assert!(first.done() && first.finish(std::slice::from_ref(&camera)).is_ok());

        let mut first = FirstPictures::new(1);
        let tries: Vec<bool> = (0..TRIES).map(|_| first.take(0, &camera, &message("rgb8", 3)).is_ok()).collect();
        assert_eq!(tries, [true, true, true, true, false]);
    }
}
