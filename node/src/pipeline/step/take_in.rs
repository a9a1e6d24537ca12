//! What follows the network: overlap, pictures, map, trajectories and objects.

use std::sync::Arc;
use std::time::Instant;

use anyhow::Result;
use storm_model::ModelError;
use storm_model::scene::{Scene, Want};
use tracing::warn;

use super::{Part, Ran, Step, StepMaker, newest_time_sec};
use crate::engine::{select, views_of};
use crate::error_line::error_line;
use crate::gate::contract::Notch;
use crate::gate::skipper::{Computed, Shadow};
use crate::map::SceneLook;
use crate::overlap::OverlapLook;
use crate::pipeline::demand::Demand;
use crate::rigid::Rigid;
use crate::source::Frame;
use crate::window::Window;

/// A surface the map has seen at one place for this long stands, whatever a network under fast ego motion says of its
/// speed: nothing that moves at a gate of 1 m/s stays in a voxel that long.
const STANDS_SEC: f64 = 1.0;

impl StepMaker {
    /// What follows the network; `shadow` belongs to the gate.
    pub(super) fn take_in(
        &mut self,
        window: Window<Frame>,
        ran: Ran,
        demand: Demand,
        shadow: Option<&Shadow>,
    ) -> Result<Option<Step>> {
        let start = Instant::now();
        let Ran { scene, ms: network_ms, approximate } = ran;
        self.timings.add("network", network_ms);
        let mut scene = match scene {
            Ok(scene) => scene,
            Err(e) => match e.downcast_ref::<ModelError>() {
                Some(ModelError::NonFinite { .. }) => {
                    self.non_finite += 1;
                    warn!("window at {} ns dropped: {}", window.stamp_ns, error_line(&e));
                    return Ok(None);
                }
                _ => return Err(e),
            },
        };
        // A network told to may give the newest timestep alone.
        let given = &window.steps[window.steps.len() - scene.shape.timesteps.min(window.steps.len())..];
        let poses: Vec<Rigid> = given.iter().flat_map(|s| s.frames.iter().map(|f| f.map_from_camera)).collect();
        let stamps_ns: Vec<i64> = given.iter().map(|s| s.stamp_ns).collect();
        self.enter(Part::Overlap);
        let look = OverlapLook {
            stamps_ns: &stamps_ns,
            epoch: window.epoch,
            map_from_anchor: &window.map_from_anchor,
            cameras: &self.cameras,
            poses: &poses,
        };
        let agreement = self.timings.time("overlap", || self.overlap.step(&mut scene, &look));
        let newest = window.steps.len() - 1;
        let views = if demand.drawn() || self.skipper.wants_views() {
            self.enter(Part::Draw);
            let targets = views_of(&window.steps[newest], &window.map_from_anchor, &self.cameras);
            let time_sec = newest_time_sec(&window);
            let want = Want { flow: true, motion: demand.motion };
            self.timings.time("render", || self.engine.render(&scene, &targets, time_sec, want))?
        } else {
            Vec::new()
        };
        self.enter(Part::Map);
        if demand.map {
            let first_new = self.given.first_new(window.epoch, &stamps_ns);
            let look = SceneLook {
                stamp_ns: window.stamp_ns,
                map_from_anchor: &window.map_from_anchor,
                scene: &scene,
                cameras: &self.cameras,
                poses: &poses,
                rendered: &views,
                confidence: &agreement.geometry,
                first_new,
            };
            self.timings.time("map", || self.map.fuse_scene(&look));
        } else {
            // What is published relative to the map's origin needs one all the same.
            self.map.set_origin(window.map_from_anchor.translation);
        }
        let (scene, views, agreement) = (Arc::new(scene), Arc::from(views), Arc::new(agreement));
        self.enter(Part::Gate);
        let computed = Computed { window, scene, views, agreement, demand, approximate };
        self.skipper.computed(&computed, shadow);
        self.follow(&computed.scene, &computed.window, demand);
        let total_ms = network_ms + start.elapsed().as_secs_f64() * 1e3;
        let notch = approximate.then_some(Notch::Approximate);
        Ok(Some(self.step(computed, demand, notch, total_ms)))
    }

    /// What moves, into the trajectories and the objects.
    pub(super) fn follow(&mut self, scene: &Scene, window: &Window<Frame>, demand: Demand) {
        self.enter(Part::Follow);
        let newest = scene.shape.timesteps - 1;
        if demand.tracks {
            let mut points = select::moving_points(scene, newest, &window.map_from_anchor, &self.config.tracks);
            for p in &mut points {
                let known = self.map.evidence(p.position_map);
                p.may_start = known.is_none_or(|k| f64::from(k.seen_for_sec) < STANDS_SEC);
            }
            self.timings.time("tracks", || self.tracker.step(window.stamp_ns, window.epoch, &points));
        }
        if demand.objects {
            let (_, parts) = select::object_points(scene, newest, &window.map_from_anchor, &self.config.tracks);
            self.timings.time("objects", || self.objects.step(window.stamp_ns, window.epoch, &parts));
        }
    }
}
