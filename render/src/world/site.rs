//! Where static things may stand around one leg, and the things themselves.

use super::layout::Layout;
use super::part::PartSpec;
use super::stream::{Footprint, Model};
use glam::{DVec2, DVec3};

/// Something that never moves.
#[derive(Debug, Clone)]
pub(crate) struct StaticBody {
    pub origin: DVec3,
    pub yaw: f64,
    pub parts: Vec<PartSpec>,
    /// Radius of a sphere around the origin that holds all parts.
    pub reach: f32,
    /// 0 for what is no road user.
    pub instance: u16,
    /// What it is, where it is a parked vehicle.
    pub model: Option<Model>,
}

impl StaticBody {
    pub(crate) fn new(origin: DVec3, yaw: f64, parts: Vec<PartSpec>) -> Self {
        let reach = parts.iter().map(PartSpec::reach).fold(0.0, f32::max);
        Self { origin, yaw, parts, reach, instance: 0, model: None }
    }
}

/// The ground around one leg while it is being built on.
pub(crate) struct Site<'a> {
    pub layout: &'a Layout,
    pub leg: usize,
    roads: std::ops::Range<usize>,
    taken: Vec<Footprint>,
    pub bodies: Vec<StaticBody>,
}

impl<'a> Site<'a> {
    pub(crate) fn new(layout: &'a Layout, leg: usize) -> Self {
        Self { layout, leg, roads: layout.roads_near(leg, 1), taken: Vec::new(), bodies: Vec::new() }
    }

    /// Whether a point lies at least `clear` metres beside the asphalt of every road nearby.
    pub(crate) fn beside_roads(&self, p: DVec2, clear: f64) -> bool {
        self.layout.roads[self.roads.clone()].iter().all(|road| road.edge_distance(p) > clear)
    }

    /// Takes a piece of ground if it lies clear of the roads and of everything placed before.
    pub(crate) fn claim(&mut self, plot: Footprint, clear: f64) -> bool {
        let (x, y) = (plot.dir * plot.half.x, plot.dir.perp() * plot.half.y);
        let steps = (plot.half.max_element() / 3.0).ceil().clamp(1.0, 8.0);
        let along = |k: f64| k / steps;
        let ring = (-(steps as i32)..=steps as i32).flat_map(|k| {
            let f = along(f64::from(k));
            [x * f + y, x * f - y, x + y * f, y * f - x]
        });
        let free = self.taken.iter().all(|other| !other.overlaps(&plot))
            && ring.into_iter().all(|offset| self.beside_roads(plot.centre + offset, clear));
        if free {
            self.taken.push(plot);
        }
        free
    }

    pub(crate) fn add(&mut self, pos: DVec2, yaw: f64, parts: Vec<PartSpec>) {
        let z = self.layout.town.kerb;
        self.bodies.push(StaticBody::new(pos.extend(z), yaw, parts));
    }
}
