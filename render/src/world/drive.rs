//! A drive: the plan, who moves how, and the pictures.

use super::ego::{Profile, Springs};
use super::ground::Ground;
use super::layout::{Layout, Town};
use super::leg::{LegContent, LegStore};
use super::light::Lamps;
use super::options::{DriveOptions, WorldError};
use super::part::PartSpec;
use super::pull_out::{PullOut, standing};
use super::rig::{DriveCamera, rig};
use super::road::District;
use super::scene::{BODY_REACH_M, BodyKey, BodyState, Frustum, Scene};
use super::shadow::Shadows;
use super::skin::Skin;
use super::sky::Sky;
use super::solids::{Solid, solids};
use super::stream::Actor;
use super::tiles::Tiles;
use super::trace::Tracer;
use super::traffic::Convoy;
use super::truth::Mover;
use crate::camera::Intrinsics;
use crate::world::dice::Dice;
use glam::{DAffine3, DMat3, DVec3, Mat3, Vec3};
use std::sync::Arc;

/// Fastest the ego goes, m/s: decides how much road a drive of some length needs.
const TOP_MPS: f64 = 22.0;
/// Road beyond what the ego can reach, metres: there must be something to look at.
const AHEAD_M: f64 = 600.0;
/// Longest stretch of the profile before the drive begins, seconds.
const LEAD_SEC: f64 = 70.0;
/// Movers farther than this from the ego are not listed.
const MOVERS_M: f64 = 150.0;

/// A procedural drive through a seeded street. Cheap to make; streets are built as the ego comes near.
#[derive(Debug)]
pub struct Drive {
    options: DriveOptions,
    cameras: Vec<DriveCamera>,
    layout: Layout,
    springs: Springs,
    convoy: Convoy,
    sky: Sky,
    skin: Option<Skin>,
    brightness: f32,
    legs: LegStore,
    solids: Vec<Solid>,
}

/// One camera at one moment, ready to trace.
pub(crate) struct ViewAt<'a> {
    skin: Option<&'a Skin>,
    pub scene: Scene,
    pub tiles: Tiles,
    pub camera: &'a Intrinsics,
    pub view_from_camera: Mat3,
}

impl ViewAt<'_> {
    pub(crate) fn tracer<'b>(&'b self, sky: &'b Sky) -> Tracer<'b> {
        Tracer {
            scene: &self.scene,
            tiles: &self.tiles,
            sky,
            skin: self.skin,
            camera: self.camera,
            view_from_camera: self.view_from_camera,
        }
    }

    /// Direction of a picture point, map axes, z-depth 1.
    pub(crate) fn direction(&self, u: f32, v: f32) -> Vec3 {
        self.view_from_camera * self.camera.ray(u, v)
    }

    pub(crate) fn camera_from_local(&self, p: DVec3) -> Vec3 {
        self.view_from_camera.transpose() * (p - self.scene.eye).as_vec3()
    }

    /// Whether a body is in the scene (those that are no body always are).
    pub(crate) fn alive(&self, body: &Option<BodyKey>) -> bool {
        body.is_none_or(|key| self.scene.parts.iter().any(|p| p.body == key))
    }
}

impl Drive {
    /// Plans a drive.
    ///
    /// # Errors
    /// [`WorldError`] where an option is outside its range.
    pub fn new(options: &DriveOptions) -> Result<Self, WorldError> {
        options.check()?;
        let seed = options.seed;
        let mut dice = Dice::new(seed, &[1]);
        let town = Town {
            seed,
            hand: if dice.chance(0.85) { 1.0 } else { -1.0 },
            district: District::roll(&mut dice),
            kerb: dice.range(0.06, 0.16),
            corner: dice.range(3.5, 6.0),
            traffic: options.traffic,
        };
        let margin = Convoy::AHEAD_MAX_SEC + 10.0 + options.stagger_sec.abs() * options.cameras as f64;
        let seconds = options.seconds + margin;
        let layout = Layout::new(town, (seconds + LEAD_SEC) * TOP_MPS + AHEAD_M);
        let profile = Profile::new(&layout, seconds);
        let convoy = Convoy::new(seed, layout.route.clone(), profile, options.traffic);
        let looks = options.looks;
        let sky = if looks.light { Sky::varied(seed) } else { Sky::new(seed) };
        let mut drive = Self {
            cameras: rig(options),
            options: options.clone(),
            springs: Springs::new(seed),
            brightness: dice.range32(1.25, 1.9) * sky.exposure,
            sky,
            skin: Skin::new(seed, looks.textures, looks.light),
            layout,
            convoy,
            legs: LegStore::default(),
            solids: Vec::new(),
        };
        if looks.solids {
            drive.solids = solids(seed, options.seconds, |time| {
                let pose = drive.local_from_base(time);
                (pose.matrix3, pose.translation)
            });
        }
        Ok(drive)
    }

    /// As given to [`Drive::new`].
    pub fn options(&self) -> &DriveOptions {
        &self.options
    }

    /// The rig.
    pub fn cameras(&self) -> &[DriveCamera] {
        &self.cameras
    }

    /// What stands along the drive's streets for the most part (some legs differ).
    pub fn district(&self) -> District {
        self.layout.town.district
    }

    /// Pictures per camera: those taken from time 0 on, before `seconds` have passed.
    pub fn frame_count(&self) -> usize {
        // Rounding must not add or lose a frame: 2 s at 10 Hz are 20 frames, whatever 0.1 is in binary.
        (self.options.seconds * self.options.rate_hz - 1e-6).ceil().max(1.0) as usize
    }

    /// When camera `camera` takes picture `frame`, seconds.
    pub fn frame_time_sec(&self, frame: usize, camera: usize) -> f64 {
        frame as f64 / self.options.rate_hz + camera as f64 * self.options.stagger_sec
    }

    /// map_from_base at a time (base: on the ground under the rear axle, x forward, y left, z up).
    pub fn map_from_base(&self, time_sec: f64) -> DAffine3 {
        let mut pose = self.local_from_base(time_sec);
        pose.translation += self.origin();
        pose
    }

    /// Speed of the ego along its way, m/s, and its acceleration, m/s^2.
    pub fn ego_speed(&self, time_sec: f64) -> (f64, f64) {
        let p = self.convoy.profile.at(time_sec);
        (p.v, p.a)
    }

    /// All road users within 150 m of the ego, by growing id. The solids of [`super::DriveLooks::solids`] are none.
    pub fn movers(&self, time_sec: f64) -> Vec<Mover> {
        let ego = self.local_from_base(time_sec).translation;
        let mut movers = Vec::new();
        self.each_actor(time_sec, ego, MOVERS_M, |_, actor| {
            let pose = (actor.pos + self.origin(), actor.yaw);
            movers.push(Mover::new(actor.id, actor.instance, &actor.model, pose, (actor.vel, actor.yaw_rate)));
        });
        for (index, leg) in self.legs_near(time_sec) {
            for (k, body) in leg.bodies.iter().enumerate() {
                let Some(model) = body.model.filter(|_| body.origin.distance(ego) < MOVERS_M) else { continue };
                let id = super::dice::fold(self.options.seed, &[2, index as u64, k as u64]);
                let now = self.leaving(index, &leg, k, time_sec).map_or_else(|| standing(body), |a| BodyState::of(&a));
                let pose = (now.origin + self.origin(), now.yaw);
                movers.push(Mover::new(id, body.instance, &model, pose, (now.vel, now.yaw_rate)));
            }
        }
        movers.sort_by_key(|m| m.id);
        movers
    }

    pub(crate) fn origin(&self) -> DVec3 {
        DVec3::from_array(self.options.origin)
    }

    pub(crate) fn sky(&self) -> &Sky {
        &self.sky
    }

    /// How many solids fly through the drive.
    #[cfg(test)]
    pub(crate) fn solid_count(&self) -> usize {
        self.solids.len()
    }

    pub(crate) fn brightness(&self) -> f32 {
        self.brightness
    }

    fn local_from_base(&self, time: f64) -> DAffine3 {
        self.springs.pose(&self.layout, &self.convoy.profile, time)
    }

    fn leg_index(&self, time: f64) -> usize {
        self.layout.leg_at(self.convoy.profile.at(time).s)
    }

    fn legs_near(&self, time: f64) -> impl Iterator<Item = (usize, Arc<LegContent>)> + '_ {
        let leg = self.leg_index(time);
        let last = self.layout.legs.len().saturating_sub(1);
        (leg.saturating_sub(2)..=(leg + 2).min(last)).map(|i| (i, self.legs.get(&self.layout, i)))
    }

    /// The parked vehicle `index` of a leg, where it has left its place.
    fn leaving(&self, leg: usize, content: &LegContent, index: usize, time: f64) -> Option<Actor> {
        let body = content.bodies.get(index).filter(|_| self.options.looks.pull_out)?;
        let model = body.model?;
        let (seed, seconds, hand) = (self.options.seed, self.options.seconds, self.layout.town.hand);
        let way = PullOut::roll(seed, leg, index, seconds, hand).filter(|way| time > way.span().0)?;
        // Where it comes to a stand it stays: nobody of the convoy may pass there later.
        let until = (way.span().0, way.span().1.max(seconds + 1.0));
        let free = || self.convoy.clear_of(until, |t| way.actor(body, model, t));
        content.leaves(index, free).then(|| way.actor(body, model, time))
    }

    /// Everybody who moves within `reach` metres of `eye`.
    fn each_actor(&self, time: f64, eye: DVec3, reach: f64, mut visit: impl FnMut(BodyKey, &Actor)) {
        for (index, actor) in self.convoy.actors(time).enumerate() {
            if actor.pos.distance(eye) < reach {
                visit(BodyKey::Companion { index: index as u32 }, &actor);
            }
        }
        for (leg, content) in self.legs_near(time) {
            for (flow, f) in content.flows.iter().enumerate() {
                for slot in f.stream.slots(time) {
                    let (s, _) = f.stream.progress(slot, time);
                    if !f.stream.taken(slot) || !f.stream.on_path(s) {
                        continue;
                    }
                    let here = f.stream.path.at(s).pos;
                    if here.distance(eye.truncate()) > reach {
                        continue;
                    }
                    if content.exists(flow, slot, &self.convoy, self.options.seconds) {
                        let key = BodyKey::Slot { leg: leg as u32, flow: flow as u32, slot };
                        visit(key, &f.stream.actor(slot, time));
                    }
                }
            }
        }
    }

    /// One camera at a time: the scene around it and what of it falls into which part of the picture.
    pub(crate) fn view(&self, camera: usize, time: f64) -> ViewAt<'_> {
        let mount = &self.cameras[camera];
        let pose = self.local_from_base(time) * mount.base_from_camera;
        let eye = pose.translation;
        let view_from_camera = pose.matrix3.as_mat3();
        let k = &mount.intrinsics;
        let ground = Ground::new(&self.layout, self.leg_index(time), eye);
        let mut scene = Scene::new(eye, ground, frustum(k, &view_from_camera));
        let mut parts: Vec<PartSpec> = Vec::new();
        for (leg, content) in self.legs_near(time) {
            for (index, body) in content.bodies.iter().enumerate() {
                let key = BodyKey::Static { leg: leg as u32, index: index as u32 };
                if let Some(actor) = self.leaving(leg, &content, index, time) {
                    if scene.wants(actor.pos, body.reach) {
                        parts.clear();
                        actor.model.parts(actor.way, actor.speed, &mut parts);
                        scene.add(key, &BodyState::of(&actor), &parts);
                    }
                } else if scene.wants(body.origin, body.reach) {
                    scene.add(key, &standing(body), &body.parts);
                }
            }
        }
        self.each_actor(time, eye, BODY_REACH_M, |key, actor| {
            let (size, middle) = actor.model.size();
            if scene.wants(actor.pos, (size.length() + middle.abs()) as f32) {
                parts.clear();
                actor.model.parts(actor.way, actor.speed, &mut parts);
                scene.add(key, &BodyState::of(actor), &parts);
            }
        });
        for (index, solid) in self.solids.iter().enumerate() {
            let state = solid.state(time);
            if scene.wants(state.origin, solid.reach) {
                scene.add(BodyKey::Solid { index: index as u32 }, &state, &solid.parts(time));
            }
        }
        scene.shadows = Shadows::new(&scene.parts, self.sky.sun);
        let ahead = self.local_from_base(time).matrix3.x_axis.as_vec3();
        scene.lamps = Lamps::new(&scene.parts, self.sky.lamps, ahead, self.options.seed);
        let tiles = Tiles::new(&scene.parts, &view_from_camera, k);
        ViewAt { skin: self.skin.as_ref(), scene, tiles, camera: k, view_from_camera }
    }

    /// Where a point fixed to a part of a body is at a time, local frame; `None` for a body or part there is not.
    pub(crate) fn point_on(&self, body: BodyKey, part: usize, local: Vec3, time: f64) -> Option<DVec3> {
        let place = |origin: DVec3, yaw: f64, spec: &PartSpec| {
            origin + DMat3::from_rotation_z(yaw) * (spec.pos + spec.rot * local).as_dvec3()
        };
        let actor = match body {
            BodyKey::Static { leg, index } => {
                let content = self.legs.get(&self.layout, leg as usize);
                let body = content.bodies.get(index as usize)?;
                if let Some(actor) = self.leaving(leg as usize, &content, index as usize, time) {
                    let mut parts = Vec::new();
                    actor.model.parts(actor.way, actor.speed, &mut parts);
                    return Some(place(actor.pos, actor.yaw, parts.get(part)?));
                }
                return Some(place(body.origin, body.yaw, body.parts.get(part)?));
            }
            BodyKey::Solid { index } => {
                let solid = self.solids.get(index as usize)?;
                let state = solid.state(time);
                return Some(place(state.origin, state.yaw, solid.parts(time).get(part)?));
            }
            BodyKey::Companion { index } => self.convoy.actor(index as usize, time),
            BodyKey::Slot { leg, flow, slot } => {
                let content = self.legs.get(&self.layout, leg as usize);
                content.flows.get(flow as usize)?.stream.actor(slot, time)
            }
        };
        let mut parts = Vec::new();
        actor.model.parts(actor.way, actor.speed, &mut parts);
        Some(place(actor.pos, actor.yaw, parts.get(part)?))
    }
}

/// The planes through the eye and the picture's sides.
fn frustum(k: &Intrinsics, view_from_camera: &Mat3) -> Frustum {
    let (w, h) = (k.width as f32, k.height as f32);
    let corner = [k.ray(0.0, 0.0), k.ray(w, 0.0), k.ray(w, h), k.ray(0.0, h)];
    let normals = std::array::from_fn(|i| {
        let inward = corner[i].cross(corner[(i + 1) % 4]).normalize();
        *view_from_camera * inward
    });
    Frustum { normals }
}
