//! Whether a camera's pictures are rectified already: the one place that decides it.
//!
//! In order: `input.rectified`, the last part of the topic's name, what the CameraInfo holds. A name goes before the
//! contents because of `image_proc`: its `image_rect` shares the CameraInfo of `image_raw`, with the raw picture's `D`.

use crate::msg::CameraInfo;

use super::cameras::picture_name;

/// Words of a topic's last part that say that the picture is rectified; they go before [`RAW`], since RealSense calls
/// rectified pictures `image_rect_raw`.
const RECTIFIED: [&str; 5] = ["rect", "rectified", "undistorted", "undist", "undistort"];
/// Words that say that it is not.
const RAW: [&str; 5] = ["raw", "unrect", "unrectified", "distorted", "dist"];
/// Relative difference of two focal lengths, or difference of centres in parts of the focal length, that is rounding.
const ROUNDING: f64 = 1e-6;

/// What was decided about a camera's pictures, and why.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rectified {
    /// True when the lens and the rectifying rotation are undone already.
    pub already: bool,
    /// Why, for people; it follows "rectified already: " or "rectified here: ".
    pub why: String,
}

impl Rectified {
    /// Decides for pictures of `topic` that `info` belongs to; `setting` is what `input.rectified` says of this camera.
    pub fn decide(info: &CameraInfo, topic: &str, setting: Option<bool>) -> Self {
        let decided = |already: bool, why: String| Self { already, why };
        if let Some(already) = setting {
            return decided(already, "input.rectified says so".into());
        }
        let last = last_part(topic);
        let no_lens = info.d.iter().all(|x| *x == 0.0);
        let named = says(last);
        if info.k_is_unset() && no_lens && named != Some(true) {
            return decided(true, "K is zero, so P alone describes the pictures".into());
        }
        match named {
            Some(true) if info.p_is_unset() => decided(true, format!("topic name `{last}`; P is zero, K is used")),
            Some(true) => decided(true, format!("topic name `{last}`")),
            Some(false) => decided(false, format!("topic name `{last}`")),
            None if !no_lens => decided(false, "D is not zero".into()),
            None if turns(info) => decided(false, "D is zero, but R is a rotation".into()),
            None if differs(info) => decided(false, "D is zero, but P is not K".into()),
            None => decided(true, "D is zero and P is K: nothing to undo".into()),
        }
    }

    /// One line for the log.
    pub fn line(&self) -> String {
        format!("{}: {}", if self.already { "rectified already" } else { "raw, rectified here" }, self.why)
    }
}

/// The last part of a topic's name without its transport: `image_rect` of `/left/image_rect/compressed`.
fn last_part(topic: &str) -> &str {
    picture_name(topic).rsplit('/').next().unwrap_or("")
}

/// Whether a name says rectified, raw, or nothing.
fn says(last: &str) -> Option<bool> {
    let lower = last.to_ascii_lowercase();
    let has = |words: &[&str]| lower.split(['_', '-', '.']).any(|word| words.contains(&word));
    if has(&RECTIFIED) {
        return Some(true);
    }
    has(&RAW).then_some(false)
}

/// True when `R` is set and not the identity.
fn turns(info: &CameraInfo) -> bool {
    const IDENTITY: [f64; 9] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let set = info.r.iter().any(|x| *x != 0.0);
    set && info.r.iter().zip(IDENTITY).any(|(a, b)| (a - b).abs() > ROUNDING)
}

/// True when `P` is set and is of another pinhole than `K`.
fn differs(info: &CameraInfo) -> bool {
    let (k, p) = (&info.k, &info.p);
    let far = |a: f64, b: f64, f: f64| (a - b).abs() > ROUNDING * f.abs();
    !info.p_is_unset()
        && (far(p[0], k[0], k[0]) || far(p[5], k[4], k[4]) || far(p[2], k[2], k[0]) || far(p[6], k[5], k[4]))
}

#[cfg(test)]
mod tests {
    use super::*;

    const K: [f64; 9] = [400.0, 0.0, 320.0, 0.0, 400.0, 240.0, 0.0, 0.0, 1.0];
    const P: [f64; 12] = [400.0, 0.0, 320.0, 0.0, 0.0, 400.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0];

    fn info(d: f64) -> CameraInfo {
        let r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        CameraInfo { width: 640, height: 480, d: vec![d, 0.0, 0.0, 0.0, 0.0], k: K, r, p: P, ..CameraInfo::default() }
    }

    #[test]
    fn the_last_part_of_the_name_goes_before_the_contents() {
        for (topic, already) in [
            ("/left/image_rect", true),
            ("/left/image_rect_color/compressed", true),
            ("/left/image_rect/zstd", true),
            ("/infra1/image_rect_raw", true),
            ("/cam/undistorted", true),
            ("/left/image_raw", false),
            ("/left/image_unrect/compressed", false),
            ("/left/image_distorted", false),
            // Words elsewhere in the name, or parts of words, say nothing.
            ("/rect/left/image", false),
            ("/direct/image_mono", false),
            ("/cam/rectangle", false),
            ("", false),
        ] {
            let decided = Rectified::decide(&info(-0.3), topic, None);
            assert_eq!(decided.already, already, "{topic}: {}", decided.why);
        }
    }

    #[test]
    fn what_the_configuration_says_goes_before_all() {
        for already in [true, false] {
            for topic in ["/a/image_rect", "/a/image_raw"] {
                let decided = Rectified::decide(&info(0.1), topic, Some(already));
                assert_eq!((decided.already, decided.why.contains("input.rectified")), (already, true));
            }
        }
    }

    #[test]
    fn without_a_word_in_the_name_the_contents_decide() {
        let decide = |info: &CameraInfo| Rectified::decide(info, "/camera/image", None);
        assert!(decide(&info(0.0)).already);
        assert!(!decide(&info(1e-3)).already);
        let mut turned = info(0.0);
        (turned.r[1], turned.r[3]) = (0.01, -0.01);
        assert!(decide(&turned).why.contains('R'));
        let mut other = info(0.0);
        other.p[0] = 380.0;
        assert!(!decide(&other).already && decide(&other).why.contains('P'));
        // A baseline makes no other pinhole.
        let mut right = info(0.0);
        right.p[3] = -40.0;
        assert!(decide(&right).already);
        let (mut no_k, mut no_p) = (info(0.0), info(0.0));
        (no_k.k, no_p.p) = ([0.0; 9], [0.0; 12]);
        assert!(decide(&no_k).already && decide(&no_k).why.contains("K is zero"));
        assert!(Rectified::decide(&no_k, "/camera/image_raw", None).already);
        assert!(decide(&no_p).already);
    }
}
