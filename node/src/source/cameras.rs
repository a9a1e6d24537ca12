//! Which image topics are cameras: those that show colour, one transport of each picture, and why the others are left out.

use crate::bag::Topic;
use crate::config::InputConfig;
use crate::decode::{Encoding, Format, Shows};

use super::topics::{CAMERA_INFO, COMPRESSED, IMAGE, MAX_CAMERAS, TopicError, is_truth, list, parent};

/// Words in a topic's name that say an image is no camera picture.
const NOT_COLOR: [&str; 7] = ["depth", "disparity", "mask", "label", "confidence", "semantic", "thermal"];
/// The same, where they stand alone between other signs (`/ir/image`, `/infra1/image`, `/left_ir/image`).
const NOT_COLOR_ALONE: [&str; 5] = ["ir", "infra", "infrared", "nir", "lwir"];
/// Last parts of the names that image_transport's plugins give beside the raw topic, best first.
const TRANSPORTS: [&str; 7] = ["compressed", "zstd", "compressedDepth", "avif", "depthz", "theora", "ffmpeg"];

/// An image topic that is no camera.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LeftOut {
    /// Its name.
    pub topic: String,
    /// Why.
    pub why: String,
}

impl std::fmt::Display for LeftOut {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} ({})", self.topic, self.why)
    }
}

/// Encoding of a raw topic's first message, `format` of a compressed one's; `None` where there is none yet.
pub type FirstEncoding<'a> = &'a dyn Fn(usize) -> Option<String>;

/// The topic without its transport: `/a/image_rect/compressed` and `/a/image_rect` are one picture.
pub fn picture_name(name: &str) -> &str {
    match name.rsplit_once('/') {
        Some((picture, last)) if TRANSPORTS.contains(&last) => picture,
        _ => name,
    }
}

/// True for messages of a video stream, whose pictures cannot be decoded one by one.
pub fn is_video(type_name: &str) -> bool {
    ["theora_image_transport/", "ffmpeg_image_transport", "h264_msgs/"].iter().any(|p| type_name.starts_with(p))
        || type_name.ends_with("/CompressedVideo")
}

/// The word in a topic's name that says it shows no colour. Of `rgb_to_depth` only `rgb` counts: it is colour, seen from
/// where depth is.
fn word_against(name: &str) -> Option<&'static str> {
    name.to_ascii_lowercase().split('/').find_map(|part| {
        let part = part.split("_to_").next().unwrap_or(part);
        let mut alone = part.split(|c: char| !c.is_ascii_alphabetic());
        let within = NOT_COLOR.into_iter().find(|w| part.contains(w));
        within.or_else(|| alone.find_map(|w| NOT_COLOR_ALONE.into_iter().find(|n| *n == w)))
    })
}

/// Cameras by topic index in the order of their names, and what was left out.
///
/// # Errors
/// No camera, more than [`MAX_CAMERAS`], or several pictures of one camera; the message names the key that settles it.
pub fn find(
    topics: &[Topic],
    config: &InputConfig,
    first: FirstEncoding,
) -> Result<(Vec<usize>, Vec<LeftOut>), TopicError> {
    let mut left_out = Vec::new();
    let mut leave = |topic: &Topic, why: String| left_out.push(LeftOut { topic: topic.name.clone(), why });
    let there = |t: &Topic| t.count > 0 && !is_truth(t, config);
    let mut found: Vec<usize> = Vec::new();
    for (i, t) in topics.iter().enumerate().filter(|(_, t)| there(t)) {
        if is_video(&t.type_name) {
            leave(t, format!("a video stream ({}), which is not decoded: republish it as images", t.type_name));
        } else if t.type_name == IMAGE || t.type_name == COMPRESSED {
            match word_against(&t.name) {
                Some(word) => leave(t, format!("no colour: its name says `{word}`")),
                None => found.push(i),
            }
        }
    }
    // Of several transports of one picture the raw one is used: nothing lost, nothing to decode.
    let rank = |i: usize| {
        let last = topics[i].name.rsplit('/').next().unwrap_or("");
        TRANSPORTS.iter().position(|t| *t == last).map_or(0, |p| p + 1)
    };
    let all = found.clone();
    found.retain(|&i| {
        let twins = all.iter().filter(|&&j| picture_name(&topics[j].name) == picture_name(&topics[i].name));
        match twins.min_by_key(|&&j| rank(j)) {
            Some(&best) if best != i => {
                leave(&topics[i], format!("another transport of {}", topics[best].name));
                false
            }
            _ => true,
        }
    });
    found.retain(|&i| {
        let Some(encoding) = first(i) else { return true };
        let shows = match topics[i].type_name.as_str() {
            COMPRESSED => Format::parse(&encoding).shows(),
            _ => Encoding::named(&encoding).map_or(Shows::Color, Encoding::shows),
        };
        match shows {
            Shows::Color => true,
            Shows::Depth | Shows::Numbers => {
                leave(&topics[i], format!("no colour: its encoding is `{encoding}`"));
                false
            }
        }
    });
    if found.is_empty() {
        let left_out = left_out.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
        return Err(TopicError::NoCamera { left_out, found: list(topics.iter()) });
    }
    found.sort_by(|&a, &b| natural(&topics[a].name).cmp(&natural(&topics[b].name)));
    let twins = found.windows(2).any(|w| {
        let dir = |i: usize| parent(picture_name(&topics[i].name)).to_string();
        !dir(w[0]).is_empty() && dir(w[0]) == dir(w[1]) && shares_info(topics, &dir(w[0]))
    });
    if twins || found.len() > MAX_CAMERAS {
        let why = if twins { "two pictures of one camera" } else { "more than 6 image topics" };
        return Err(TopicError::Ambiguous {
            part: format!("the set of cameras ({why})"),
            key: "input.images",
            candidates: list(found.iter().map(|&i| &topics[i])),
        });
    }
    Ok((found, left_out))
}

/// True when `dir` holds one CameraInfo for all its images, so that several images there are of one camera.
fn shares_info(topics: &[Topic], dir: &str) -> bool {
    topics.iter().any(|t| t.type_name == CAMERA_INFO && parent(&t.name) == dir)
}

/// Splits a name into text and numbers, so that camera10 sorts after camera9.
fn natural(name: &str) -> Vec<(String, u64)> {
    let mut parts = Vec::new();
    let (mut text, mut digits) = (String::new(), String::new());
    for c in name.chars() {
        if c.is_ascii_digit() {
            digits.push(c);
            continue;
        }
        if !digits.is_empty() {
            parts.push((std::mem::take(&mut text), std::mem::take(&mut digits).parse().unwrap_or(u64::MAX)));
        }
        text.push(c);
    }
    parts.push((text, digits.parse().unwrap_or(0)));
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    fn topic(name: &str, type_name: &str) -> Topic {
        Topic { name: name.into(), type_name: type_name.into(), serialization: "cdr".into(), count: 5 }
    }

    /// Names of the cameras found and of what was left out.
    fn names(topics: &[Topic], first: FirstEncoding) -> (Vec<String>, Vec<String>) {
        let (found, left) = find(topics, &InputConfig::default(), first).unwrap();
        (found.iter().map(|&i| topics[i].name.clone()).collect(), left.into_iter().map(|l| l.topic).collect())
    }

    #[test]
    fn what_a_name_says_against_colour() {
        for (name, word) in [
            ("/camera/aligned_depth_to_color/image_raw", Some("depth")),
            ("/camera/depth/image_rect_raw/compressedDepth", Some("depth")),
            ("/camera/infra1/image_rect_raw", Some("infra")),
            ("/camera/ir/image_raw", Some("ir")),
            ("/camera/left_ir/image_raw", Some("ir")),
            ("/stereo/disparity_image", Some("disparity")),
            ("/Thermal/image_raw", Some("thermal")),
            ("/rgb_to_depth/image_raw", None),
            ("/infrastructure/air/image", None),
            ("/camera/color/image_raw/compressed", None),
        ] {
            assert_eq!(word_against(name), word, "{name}");
        }
    }

    #[test]
    fn one_transport_of_each_picture() {
        let all = [
            topic("/c/image_raw", IMAGE),
            topic("/c/image_raw/compressed", COMPRESSED),
            topic("/c/image_raw/zstd", COMPRESSED),
            topic("/c/image_raw/theora", "theora_image_transport/msg/Packet"),
        ];
        let (found, left) = names(&all, &|_| None);
        assert_eq!((found.as_slice(), left.len()), (&["/c/image_raw".to_owned()][..], 3));
        assert_eq!(names(&all[1..], &|_| None).0, ["/c/image_raw/compressed"]);
        assert_eq!(names(&all[2..], &|_| None).0, ["/c/image_raw/zstd"]);
        let e = find(&all[3..], &InputConfig::default(), &|_| None).unwrap_err().to_string();
        assert!(e.contains("/c/image_raw/theora") && e.contains("video stream"), "{e}");
    }

    #[test]
    fn an_encoding_of_depth_is_no_camera() {
        let all = [topic("/a/image", IMAGE), topic("/b/image", IMAGE), topic("/d/image/compressed", COMPRESSED)];
        let first = |i: usize| Some(["rgb8", "32FC1", "16UC1; png compressed "][i].to_owned());
        let (found, left) = names(&all, &first);
        assert_eq!((found, left), (vec!["/a/image".to_owned()], vec!["/b/image".into(), "/d/image/compressed".into()]));
        let e = find(&all[1..], &InputConfig::default(), &|i| first(i + 1)).unwrap_err().to_string();
        assert!(e.contains("`32FC1`") && e.contains("input.images"), "{e}");
    }

    #[test]
    fn numbers_in_names_sort_as_numbers() {
        let mut names = ["/camera10/image", "/camera9/image", "/camera1/image"];
        names.sort_by_key(|n| natural(n));
        assert_eq!(names, ["/camera1/image", "/camera9/image", "/camera10/image"]);
    }
}
