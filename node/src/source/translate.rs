//! One CDR message to events: the same for a message from a bag and one that just came in.

use std::sync::Arc;

use anyhow::Result;

use crate::cdr::decode as cdr;
use crate::decode;
use crate::error_line::error_line;
use crate::pipeline::guard::caught;
use crate::sync::DropReason;

use super::event::{Event, Frame, Truth};
use super::rig::{Rig, RigCamera};
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
        /// True for CompressedImage.
        compressed: bool,
    },
    /// Nothing.
    None,
}

/// Turns one message of `topic` into events. `logged_ns` names the message in errors when its own stamp cannot be read. A
/// decoder that panics loses this one message: it keeps nothing from one to the next.
pub fn translate(rig: &Rig, role: &Role, topic: &str, data: &[u8], logged_ns: i64, each: &mut dyn FnMut(Event)) {
    let (reason, why) = match caught(|| events(rig, role, data)) {
        Ok(Ok(events)) => {
            return events.into_iter().for_each(|event| {
                each(if rig.stamps_recorded { event.stamped(logged_ns) } else { event });
            });
        }
        Ok(Err(e)) => (DropReason::Decode, error_line(&e)),
        Err(what) => (DropReason::Panic, format!("its decoder panicked ({what}); this is a fault of the program")),
    };
    // The header stamp when it can be read, else the log time.
    let stamp_ns = cdr::header(data).map_or(logged_ns, |h| h.stamp_ns);
    let camera = if let Role::Image { camera, .. } = role { Some(*camera) } else { None };
    each(Event::Lost { camera, reason, detail: format!("{topic} at {stamp_ns} ns: {why}") });
}

fn events(rig: &Rig, role: &Role, data: &[u8]) -> Result<Vec<Event>> {
    Ok(match role {
        Role::Image { camera, compressed } => {
            let (stamp_ns, frame) = picture(rig, *camera, *compressed, data)?;
            vec![Event::Image { camera: *camera, stamp_ns, frame }]
        }
        Role::Pose { type_name } => {
            let p = cdr::pose(type_name, data)?;
            vec![Event::Pose { stamp_ns: p.header.stamp_ns, map_from_base: p.pose }]
        }
        Role::Transform => cdr::tf_message(data)?.into_iter().map(|t| Event::Transform(Box::new(t))).collect(),
        Role::StaticTransform => {
            cdr::tf_message(data)?.into_iter().map(|t| Event::StaticTransform(Box::new(t))).collect()
        }
        Role::Truth { camera, compressed: true, .. } => vec![packed_depth(*camera, data)?],
        Role::Truth { camera, kind, compressed: false } => vec![truth(*camera, *kind, data)?],
        Role::None => Vec::new(),
    })
}

fn picture(rig: &Rig, camera: usize, compressed: bool, data: &[u8]) -> Result<(i64, Frame)> {
    let RigCamera { rectifier, validity, .. } = &rig.cameras[camera];
    let (stamp_ns, full) = if compressed {
        let image = cdr::compressed_image(data)?;
        (image.header.stamp_ns, decode::compressed_of_size(&image, Some(rectifier.source_size()))?)
    } else {
        let image = cdr::image(data)?;
        (image.header.stamp_ns, decode::image_to_rgb(&image)?)
    };
    let mut rgb = rectifier.apply(&full)?;
    if let Some(validity) = validity {
        validity.fill(&mut rgb);
    }
    Ok((stamp_ns, Frame { rgb: Arc::new(rgb), valid: validity.as_ref().map(|v| v.valid().clone()) }))
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

/// Ground-truth depth in a CompressedImage.
fn packed_depth(camera: usize, data: &[u8]) -> Result<Event> {
    let message = cdr::compressed_image(data)?;
    let depth = decode::compressed_to_depth(&message)?;
    Ok(Event::Truth {
        camera,
        stamp_ns: message.header.stamp_ns,
        kind: TruthKind::Depth,
        width: depth.width,
        height: depth.height,
        data: Arc::new(Truth::Depth(depth.data)),
    })
}
