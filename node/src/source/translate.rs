//! One CDR message to events: the same for a message from a bag and one that just came in.

use std::sync::Arc;

use anyhow::Result;

use crate::cdr::decode as cdr;
use crate::decode::{self, RgbPicture};
use crate::sync::DropReason;

use super::event::{Event, Frame, Truth};
use super::rig::Rig;
use super::topics::TruthKind;

/// What a topic's messages are turned into.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Role {
    /// Pictures of a camera.
    Image {
        /// Which camera.
        camera: usize,
        /// True for CompressedImage.
        compressed: bool,
    },
    /// Vehicle poses, of a type [`cdr::pose`] reads.
    Pose {
        /// The message type.
        type_name: String,
    },
    /// Moving transforms.
    Transform,
    /// Transforms that hold at all times.
    StaticTransform,
    /// Ground truth.
    Truth {
        /// Which camera.
        camera: usize,
        /// What it holds.
        kind: TruthKind,
    },
    /// Nothing.
    None,
}

/// Turns one message of `topic` into events. `logged_ns` names the message in errors when its own stamp cannot be read.
pub fn translate(rig: &Rig, role: &Role, topic: &str, data: &[u8], logged_ns: i64, each: &mut dyn FnMut(Event)) {
    let lost = |camera: Option<usize>, why: String| {
        // The header stamp when it can be read, else the log time.
        let stamp_ns = cdr::header(data).map_or(logged_ns, |h| h.stamp_ns);
        Event::Lost { camera, reason: DropReason::Decode, detail: format!("{topic} at {stamp_ns} ns: {why}") }
    };
    match role {
        Role::Image { camera, compressed } => match picture(rig, *camera, *compressed, data) {
            Ok((stamp_ns, rgb)) => {
                each(Event::Image { camera: *camera, stamp_ns, frame: Frame { rgb: Arc::new(rgb) } });
            }
            Err(e) => each(lost(Some(*camera), format!("{e:#}"))),
        },
        Role::Pose { type_name } => match cdr::pose(type_name, data) {
            Ok(p) => each(Event::Pose { stamp_ns: p.header.stamp_ns, map_from_base: p.pose }),
            Err(e) => each(lost(None, e.to_string())),
        },
        Role::Transform | Role::StaticTransform => match cdr::tf_message(data) {
            Ok(list) => list.into_iter().for_each(|t| {
                let t = Box::new(t);
                each(if *role == Role::Transform { Event::Transform(t) } else { Event::StaticTransform(t) });
            }),
            Err(e) => each(lost(None, e.to_string())),
        },
        Role::Truth { camera, kind } => match truth(*camera, *kind, data) {
            Ok(event) => each(event),
            Err(e) => each(lost(None, format!("{e:#}"))),
        },
        Role::None => {}
    }
}

fn picture(rig: &Rig, camera: usize, compressed: bool, data: &[u8]) -> Result<(i64, RgbPicture)> {
    let (stamp_ns, full) = if compressed {
        let image = cdr::compressed_image(data)?;
        (image.header.stamp_ns, decode::compressed_to_rgb(&image)?)
    } else {
        let image = cdr::image(data)?;
        (image.header.stamp_ns, decode::image_to_rgb(&image)?)
    };
    Ok((stamp_ns, rig.cameras[camera].rectifier.apply(&full)?))
}

fn truth(camera: usize, kind: TruthKind, data: &[u8]) -> Result<Event> {
    let image = cdr::image(data)?;
    let (width, height) = (image.width as usize, image.height as usize);
    let data = match kind {
        TruthKind::Depth => Truth::Depth(decode::image_to_depth(&image)?.data),
        TruthKind::Flow => Truth::Flow(decode::image_to_vectors(&image)?),
        TruthKind::Moving | TruthKind::Sky | TruthKind::Instance => Truth::Mask(decode::image_to_labels(&image)?),
    };
    Ok(Event::Truth { camera, stamp_ns: image.header.stamp_ns, kind, width, height, data: Arc::new(data) })
}
