//! Scores of one method over many clips.

use anyhow::Result;
use glam::Vec3;
use storm_model::metrics::Mean;
use storm_model::metrics::flow::{AV2_DYNAMIC_MPS, Flow, FlowEvaluation, FlowFrame, three_way_epe};
use storm_model::metrics::image::{Image, ImageScores};
use storm_model::metrics::mask::{foreground_ari, iou};
use storm_model::metrics::mends::Mends;
use storm_model::scene::{RenderedView, Want};
use storm_render::View;
use storm_render::raster::CpuRasterizer;

use super::breakdown::{Breakdown, BreakdownFigures, FlowPixel};
use super::clip::unproject;
use super::tracks::{StepCloud, apd3d};
use super::{Clip, ClipFrame, Placed, Prediction};
use crate::engine::figures::Figures;
use crate::engine::select::{MOVING_MPS, SURFACE_OPACITY};
use crate::engine::truth::{TruthAt, unit};
use crate::engine::views_of;
use crate::pipeline::messages::motion_mask;
use crate::window::relative;

/// Scores of one method over many clips.
#[derive(Default)]
pub struct Tally {
    images: Vec<ImageScores>,
    flow: FlowEvaluation,
    /// Moving foreground, still foreground, background: means of the timesteps.
    three_way: [Mean; 3],
    ari: Mean,
    moving_iou: Mean,
    apd3d: Mean,
    ms: Mean,
    breakdown: Breakdown,
}

/// One context timestep, all cameras pooled; only cameras whose depth and flow are known.
#[derive(Default)]
struct StepFlow {
    pred: Vec<Flow>,
    truth: Vec<Flow>,
    depth: Vec<f32>,
    /// Empty where the method has no depth.
    pred_depth: Vec<f32>,
    /// Object numbers; empty where they are unknown.
    instance: Vec<u16>,
}

/// Motion masks of one context timestep, all cameras pooled; only cameras whose truth is known.
#[derive(Default)]
struct StepMask {
    groups: Vec<u32>,
    true_groups: Vec<u32>,
    moves: Vec<bool>,
    truly_moves: Vec<bool>,
}

impl Tally {
    /// Means over everything scored.
    pub fn figures(&self) -> Figures {
        let flow = self.flow.means();
        let mut mean = Mean::default();
        self.three_way.iter().for_each(|kind| mean.add(kind.value()));
        let [dynamic, still, background] = self.three_way.map(|kind| kind.value());
        Figures {
            epe3d: flow.epe3d,
            acc5: flow.acc5,
            acc10: flow.acc10,
            theta: flow.theta,
            epe3d_three_way: mean.value(),
            epe3d_foreground_dynamic: dynamic,
            epe3d_foreground_static: still,
            epe3d_background_static: background,
            missed_share: self.breakdown.movers().missed_share,
            fg_ari: self.ari.value(),
            moving_iou: self.moving_iou.value(),
            apd3d: self.apd3d.value(),
            ms: self.ms.value(),
            ..Figures::of_images(&self.images)
        }
    }

    /// Where the error is.
    pub fn breakdown(&self) -> BreakdownFigures {
        self.breakdown.figures()
    }

    /// Counts what the other counted too.
    pub fn join(&mut self, other: &Self) {
        self.images.extend_from_slice(&other.images);
        self.flow.join(&other.flow);
        self.three_way.iter_mut().zip(&other.three_way).for_each(|(mean, other)| mean.join(other));
        self.ari.join(&other.ari);
        self.moving_iou.join(&other.moving_iou);
        self.apd3d.join(&other.apd3d);
        self.ms.join(&other.ms);
        self.breakdown.join(&other.breakdown);
    }

    /// Held-out pictures scored.
    pub fn images(&self) -> usize {
        self.images.len()
    }

    /// Adds a method's answer for one clip, and how long it took.
    pub fn add(&mut self, clip: &Clip, prediction: &Prediction, ms: Option<f64>) -> Result<()> {
        self.ms.add(ms);
        match prediction {
            Prediction::Scenes(scenes) => self.scenes(clip, scenes),
            Prediction::Flow(flow) => self.flow_only(clip, flow),
            Prediction::NearestContext => self.nearest(clip),
        }
    }

    /// Held-out frames drawn, then flow, masks and trajectories of the context frames.
    fn scenes(&mut self, clip: &Clip, scenes: &[Placed]) -> Result<()> {
        let Some(first) = scenes.first() else { return Ok(()) };
        scenes.iter().for_each(|s| self.breakdown.bases().add(&s.scene.motion_bases, &s.scene.config));
        let mut raster = CpuRasterizer::new(first.scene.raster_settings())?;
        let mut flows = Vec::new();
        let mut clouds = Vec::new();
        for frame in clip.frames.iter().filter(|f| f.context.is_some() || f.held_out()) {
            let nearest = scenes.iter().min_by_key(|s| s.stamp_ns.abs_diff(frame.set.stamp_ns));
            let Some(placed) = nearest else { continue };
            let views = draw(placed, clip, frame, &mut raster)?;
            let Some(step) = frame.context else {
                for ((view, truth), seen) in views.iter().zip(&frame.truth).zip(&frame.set.frames) {
                    let (pred, true01) = (unit(&view.rgb8()), unit(&seen.item.rgb.data));
                    self.image(clip, truth, &pred, &true01, Some(view))?;
                }
                continue;
            };
            let map_from_anchor = placed.map_from_anchor.rotation.as_quat();
            let (mut flow, mut mask) = (StepFlow::default(), StepMask::default());
            for (view, truth) in views.iter().zip(&frame.truth) {
                let pred: Vec<Flow> =
                    view.flow.iter().flatten().map(|&f| (map_from_anchor * Vec3::from(f)).to_array()).collect();
                flow.add(truth, &pred, Some(&view.depth));
                let groups: Vec<u32> = motion_mask(view).into_iter().map(u32::from).collect();
                mask.add(truth, groups.iter().map(|&g| g != 0), Some(&groups));
            }
            flows.push(flow);
            self.mask(&mask)?;
            // A single scene of all timesteps, or one scene per timestep.
            let part = if placed.scene.shape.timesteps == clip.window.steps.len() { step } else { 0 };
            clouds.push(match placed.pixel_aligned {
                true => gaussian_cloud(clip, placed, part),
                false => drawn_cloud(clip, step, &views),
            });
        }
        self.flows(clip, &flows)?;
        self.apd3d.add(apd3d(clip, &clouds)?);
        Ok(())
    }

    /// Flow given for every context pixel, on true geometry.
    fn flow_only(&mut self, clip: &Clip, flow: &[Vec<Vec<Flow>>]) -> Result<()> {
        let anchor_from_map = clip.window.map_from_anchor.rotation.as_quat().conjugate();
        let mut flows = Vec::new();
        let mut clouds = Vec::new();
        for (step, frame) in clip.context() {
            let (mut pooled, mut mask, mut cloud) = (StepFlow::default(), StepMask::default(), StepCloud::default());
            for (camera, (view, truth)) in clip.views(step).iter().zip(&frame.truth).enumerate() {
                let Some(pred) = flow.get(step).and_then(|cameras| cameras.get(camera)) else { continue };
                pooled.add(truth, pred, None);
                mask.add(truth, pred.iter().map(|&f| Vec3::from(f).length() >= MOVING_MPS), None);
                let Some(depth) = &truth.depth else { continue };
                for (i, (&z, &f)) in depth.iter().zip(pred).enumerate() {
                    let v = anchor_from_map * Vec3::from(f);
                    cloud.push(unproject(view, i, z), v, v, z > 0.0);
                }
            }
            flows.push(pooled);
            self.mask(&mask)?;
            clouds.push(cloud);
        }
        self.flows(clip, &flows)?;
        self.apd3d.add(apd3d(clip, &clouds)?);
        Ok(())
    }

    /// Held-out frames answered with the nearest context picture of the same camera.
    fn nearest(&mut self, clip: &Clip) -> Result<()> {
        for frame in clip.frames.iter().filter(|f| f.held_out()) {
            for (camera, (seen, truth)) in frame.set.frames.iter().zip(&frame.truth).enumerate() {
                let context = clip.window.steps.iter().filter_map(|s| s.frames.get(camera));
                let Some(nearest) = context.min_by_key(|f| f.stamp_ns.abs_diff(seen.stamp_ns)) else { continue };
                let (pred, true01) = (unit(&nearest.item.rgb.data), unit(&seen.item.rgb.data));
                self.image(clip, truth, &pred, &true01, None)?;
            }
        }
        Ok(())
    }

    /// One held-out image, colours 0-1; `view` is the rendering it comes from, if it is one.
    fn image(
        &mut self,
        clip: &Clip,
        truth: &TruthAt,
        pred: &[f32],
        true01: &[f32],
        view: Option<&RenderedView>,
    ) -> Result<()> {
        self.images.push(truth.compare(pred, true01, view.map(|view| view.depth.as_slice()))?);
        let image = |values| Image { width: truth.size.0, height: truth.size.1, channels: 3, values };
        // Where nobody says what is sky, it is what the rendering leaves to the sky.
        let known = truth.sky.as_ref().map(|sky| sky.iter().map(|&s| s != 0).collect());
        let sky: Option<Vec<bool>> =
            known.or_else(|| view.map(|view| view.alpha.iter().map(|&a| a < SURFACE_OPACITY).collect()));
        let (known, share) = truth.or_true(pred, true01);
        let mends = Mends::of(&image(&known), &image(true01), sky.as_deref())?;
        // Pixels without an error leave every gain what it is, but not the mean error.
        let of_seen = |m: Mends| Mends { psnr: m.psnr.map(|db| db + 10.0 * share.log10()), ..m };
        self.breakdown.mends(if share < 1.0 { mends.map(of_seen) } else { mends });
        for (i, &z) in truth.depth.iter().flatten().enumerate().filter(|(_, z)| **z > 0.0) {
            let channels = 3 * i..3 * i + 3;
            if let (Some(p), Some(t)) = (pred.get(channels.clone()), true01.get(channels)) {
                let id = truth.instance.as_ref().and_then(|ids| ids.get(i));
                self.breakdown.color(p, t, z, id.and_then(|id| clip.classes.get(id).copied()));
            }
        }
        Ok(())
    }

    /// The context timesteps of one clip are one sample, as in the paper's program.
    fn flows(&mut self, clip: &Clip, flows: &[StepFlow]) -> Result<()> {
        let known: Vec<&StepFlow> = flows.iter().filter(|f| !f.truth.is_empty()).collect();
        let frame = |f: &&StepFlow| -> Vec<bool> { f.depth.iter().map(|&d| d > 0.0).collect() };
        for f in &known {
            let instances = Some(&f.instance).filter(|ids| ids.len() == f.truth.len());
            for i in (0..f.truth.len()).filter(|&i| f.depth[i] > 0.0) {
                let id = instances.and_then(|ids| ids.get(i));
                let pixel = FlowPixel {
                    pred: f.pred[i],
                    truth: f.truth[i],
                    depth: f.depth[i],
                    pred_depth: f.pred_depth.get(i).copied(),
                    user: id.is_some_and(|&id| id != 0),
                    class: id.and_then(|id| clip.classes.get(id).copied()),
                };
                self.breakdown.flow(i, &pixel)?;
            }
            if f.instance.len() == f.truth.len() {
                let foreground: Vec<bool> = f.instance.iter().map(|&id| id != 0).collect();
                let kinds = three_way_epe(&f.pred, &f.truth, &foreground, Some(&frame(f)), AV2_DYNAMIC_MPS)?;
                let values = [kinds.foreground_dynamic, kinds.foreground_static, kinds.background_static];
                self.three_way.iter_mut().zip(values).for_each(|(mean, value)| mean.add(value));
            }
        }
        let frames: Vec<FlowFrame> =
            known.iter().map(|f| FlowFrame { pred: &f.pred, truth: &f.truth, depth: &f.depth, ground: None }).collect();
        Ok(self.flow.add(&frames)?)
    }

    fn mask(&mut self, mask: &StepMask) -> Result<()> {
        if mask.groups.len() == mask.true_groups.len() {
            self.ari.add(foreground_ari(&mask.groups, &mask.true_groups, 0)?);
        }
        self.moving_iou.add(iou(&mask.moves, &mask.truly_moves, None)?);
        Ok(())
    }
}

impl StepFlow {
    fn add(&mut self, truth: &TruthAt, pred: &[Flow], pred_depth: Option<&[f32]>) {
        let (Some(flow), Some(depth)) = (&truth.flow, &truth.depth) else { return };
        if flow.len() != pred.len() {
            return;
        }
        self.pred.extend_from_slice(pred);
        self.truth.extend_from_slice(flow);
        self.depth.extend_from_slice(depth);
        self.pred_depth.extend(pred_depth.into_iter().flatten());
        self.instance.extend(truth.instance.iter().flatten());
    }
}

impl StepMask {
    fn add(&mut self, truth: &TruthAt, moves: impl Iterator<Item = bool>, groups: Option<&[u32]>) {
        let Some(moving) = &truth.moving else { return };
        self.moves.extend(moves.enumerate().map(|(i, moves)| moves && truth.is_valid(i)));
        self.truly_moves.extend(moving.iter().map(|&m| m != 0));
        if let (Some(groups), Some(instance)) = (groups, &truth.instance) {
            self.groups.extend(groups.iter().enumerate().map(|(i, &group)| if truth.is_valid(i) { group } else { 0 }));
            let group = |(&id, &m): (&u16, &u16)| if m != 0 { u32::from(id) } else { 0 };
            self.true_groups.extend(instance.iter().zip(moving).map(group));
        }
    }
}

/// All cameras of a frame, each at its own stamp.
fn draw(placed: &Placed, clip: &Clip, frame: &ClipFrame, raster: &mut CpuRasterizer) -> Result<Vec<RenderedView>> {
    let context = frame.context.is_some();
    let want = Want { flow: context, motion: context };
    let targets = views_of(&frame.set, &placed.map_from_anchor, &clip.cameras);
    let stamps: Vec<i64> = frame.set.frames.iter().map(|f| f.stamp_ns).collect();
    if stamps.windows(2).all(|pair| pair[0] == pair[1]) {
        let stamp_ns = stamps.first().copied().unwrap_or(frame.set.stamp_ns);
        return Ok(placed.scene.render(raster, &targets, clip.time_sec(stamp_ns), want)?);
    }
    let mut views = Vec::new();
    for (target, stamp_ns) in targets.into_iter().zip(stamps) {
        views.extend(placed.scene.render(raster, &[target], clip.time_sec(stamp_ns), want)?);
    }
    Ok(views)
}

/// The Gaussians of one timestep, `part` of the scene, in the window's frame.
fn gaussian_cloud(clip: &Clip, placed: &Placed, part: usize) -> StepCloud {
    let pose = relative(&clip.window.map_from_anchor, &placed.map_from_anchor).to_f32();
    let g = &placed.scene.gaussians;
    let mut cloud = StepCloud::default();
    for camera in 0..clip.cameras.len() {
        for i in placed.scene.shape.picture(part, camera) {
            let turned = |v: [f32; 3]| pose.transform_vector3(Vec3::from(v));
            let place = pose.transform_point3(Vec3::from(g.means[i]));
            let (backward, forward) = (turned(g.velocity_backward[i]), turned(g.velocity_forward[i]));
            cloud.push(place, backward, forward, g.opacities[i] >= SURFACE_OPACITY);
        }
    }
    cloud
}

/// What the pictures of one timestep show, for scenes whose Gaussians belong to no pixel; these stand still.
fn drawn_cloud(clip: &Clip, step: usize, views: &[RenderedView]) -> StepCloud {
    let mut cloud = StepCloud::default();
    let cameras: Vec<View> = clip.views(step);
    for (view, camera) in views.iter().zip(&cameras) {
        for (i, (&z, &alpha)) in view.depth.iter().zip(&view.alpha).enumerate() {
            cloud.push(unproject(camera, i, z), Vec3::ZERO, Vec3::ZERO, alpha >= SURFACE_OPACITY);
        }
    }
    cloud
}
