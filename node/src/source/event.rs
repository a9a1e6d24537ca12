//! What a source tells the rest of the program.

use std::sync::Arc;

use crate::decode::RgbPicture;
use crate::msg;
use crate::rigid::Rigid;
use crate::sync::DropReason;

use super::topics::TruthKind;

/// One camera's picture at the network's size, rectified.
#[derive(Debug, Clone)]
pub struct Frame {
    /// The picture; pixels that show nothing have their neighbours' colours.
    pub rgb: Arc<RgbPicture>,
    /// Per pixel, row by row: whether it shows something. None: all do.
    pub valid: Option<Arc<[bool]>>,
}

impl Frame {
    /// A picture whose pixels all show something.
    pub fn whole(rgb: RgbPicture) -> Self {
        Self { rgb: Arc::new(rgb), valid: None }
    }

    /// Whether pixel `i` shows something.
    pub fn is_valid(&self, i: usize) -> bool {
        self.valid.as_ref().is_none_or(|valid| valid.get(i).copied().unwrap_or(true))
    }
}

/// One ground-truth image, at the recording's own size.
#[derive(Debug, Clone, PartialEq)]
pub enum Truth {
    /// z-depth, metres, 0 for sky.
    Depth(Vec<f32>),
    /// Scene flow, m/s in map axes.
    Flow(Vec<[f32; 3]>),
    /// Not 0 where the surface moves, or where the sky is, or the object's number, by kind.
    Mask(Vec<u16>),
}

/// One thing that happened, in the order it was recorded or received.
#[derive(Debug, Clone)]
pub enum Event {
    /// A picture arrived.
    Image {
        /// Which camera.
        camera: usize,
        /// Its stamp, nanoseconds.
        stamp_ns: i64,
        /// The picture.
        frame: Frame,
    },
    /// A vehicle pose arrived.
    Pose {
        /// Its stamp, nanoseconds.
        stamp_ns: i64,
        /// The pose as read; not checked yet.
        map_from_base: Rigid,
    },
    /// A moving transform arrived.
    Transform(Box<msg::TransformStamped>),
    /// A transform that holds at all times arrived.
    StaticTransform(Box<msg::TransformStamped>),
    /// A ground-truth image arrived.
    Truth {
        /// Which camera.
        camera: usize,
        /// Its stamp, nanoseconds.
        stamp_ns: i64,
        /// What it holds.
        kind: TruthKind,
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// The values, row-major.
        data: Arc<Truth>,
    },
    /// A message was lost before it became anything; `detail` names topic, stamp and value.
    Lost {
        /// Camera it belonged to, if it was an image.
        camera: Option<usize>,
        /// Why.
        reason: DropReason,
        /// Topic, stamp and what was wrong.
        detail: String,
    },
}

impl Event {
    /// The same, with another stamp than its header's.
    pub fn stamped(mut self, ns: i64) -> Self {
        match &mut self {
            Self::Image { stamp_ns, .. } | Self::Pose { stamp_ns, .. } | Self::Truth { stamp_ns, .. } => *stamp_ns = ns,
            Self::Transform(t) => t.header.stamp_ns = ns,
            Self::StaticTransform(_) | Self::Lost { .. } => {}
        }
        self
    }
}
