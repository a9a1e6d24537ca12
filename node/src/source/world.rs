//! A procedural drive as windows, without a bag in between: what benchmarks and tests feed the engine.

use std::sync::Arc;

use storm_render::world::{Drive, WorldFrame};

use crate::config::WindowConfig;
use crate::decode::RgbPicture;
use crate::rigid::Rigid;
use crate::window::{PosedFrame, PosedSet, Window, WindowBuilder};

use super::Frame;
use super::event::Truth;
use super::topics::TruthKind;
use crate::pipeline::front::TruthImage;

/// All cameras of `drive` at frame `frame`, posed, at the drive's own picture size; and the same with ground truth.
pub fn posed_set(drive: &Drive, frame: usize) -> (PosedSet<Frame>, Vec<WorldFrame>) {
    let mut frames = Vec::new();
    let mut truth = Vec::new();
    for (camera, c) in drive.cameras().iter().enumerate() {
        let time_sec = drive.frame_time_sec(frame, camera);
        let picture = drive.render(camera, time_sec);
        let rgb = RgbPicture { width: picture.width, height: picture.height, data: picture.rgb.clone() };
        frames.push(PosedFrame {
            stamp_ns: (time_sec * 1e9).round() as i64,
            map_from_camera: Rigid::from(&(drive.map_from_base(time_sec) * c.base_from_camera)),
            item: Frame::whole(rgb),
        });
        truth.push(picture);
    }
    let stamp_ns = frames.first().map_or(0, |f| f.stamp_ns);
    (PosedSet { stamp_ns, epoch: 0, frames }, truth)
}

/// A drawn frame's ground truth as the scorer takes it.
pub fn truth_images(frame: WorldFrame) -> [(TruthKind, TruthImage); 4] {
    let WorldFrame { width, height, depth, flow, sky, moving, .. } = frame;
    let image = |data| TruthImage { width, height, data: Arc::new(data) };
    let mask = |m: Vec<u8>| Truth::Mask(m.into_iter().map(u16::from).collect());
    [
        (TruthKind::Depth, image(Truth::Depth(depth))),
        (TruthKind::Flow, image(Truth::Flow(flow))),
        (TruthKind::Moving, image(mask(moving))),
        (TruthKind::Sky, image(mask(sky))),
    ]
}

/// The first window a drive gives, anchored at camera `reference`; `None` when the drive is too short for one.
pub fn first_window(drive: &Drive, config: &WindowConfig, reference: usize) -> Option<Window<Frame>> {
    let mut builder = WindowBuilder::new(config, reference);
    (0..drive.frame_count()).find_map(|i| builder.push(posed_set(drive, i).0))
}
