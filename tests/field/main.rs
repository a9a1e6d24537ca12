//! Recordings as people make them: the control drive with one quirk each, against the control drive's own figures.
//!
//! A quirk is a function of a [`recording::Recording`]; [`run::replay`] runs it, [`run::Ran::like_control`] says that the
//! result is the control's, [`run::Ran::refused`] that it was refused in one sentence.
#![allow(dead_code, clippy::unwrap_used, clippy::expect_used)]

mod calibration;
mod encodings;
mod formats;
mod frames;
mod not_color;
mod recording;
mod run;
mod time;
mod unseen;

use recording::Recording;
use run::control;

#[test]
fn the_control_drive_is_whole() {
    let control = control();
    assert_eq!(control.code, 0, "{}", control.stderr);
    assert_eq!(control.metrics["frames_in"], 22);
    assert!(control.metrics["steps"].as_u64().unwrap() >= 6, "{}", control.metrics);
    assert!(control.psnr() > 15.0, "{}", control.psnr());
    assert!(Recording::control().0.len() > 50);
}
