//! One road: a centreline with a cross-section (lanes, parking, pavement), its paint, and the places where others cross it.

use super::dice::{Dice, fold};
use super::layout::Town;
use super::path::Path;
use glam::DVec2;

/// What stands beside a road.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum District {
    /// High fronts, wide pavements, shops, much traffic.
    Downtown,
    /// Rows of houses of three to five floors, parked cars.
    Terraces,
    /// Detached houses, gardens, hedges and fences.
    Suburb,
    /// Trees and lawns.
    Park,
    /// Halls, yards, lorries.
    Industrial,
    /// Fields, few houses, no pavement.
    Rural,
}

impl District {
    /// All of them.
    pub const ALL: [Self; 6] =
        [Self::Downtown, Self::Terraces, Self::Suburb, Self::Park, Self::Industrial, Self::Rural];

    pub(crate) fn roll(dice: &mut Dice) -> Self {
        dice.pick(&Self::ALL)
    }
}

/// A road's cross-section and character. Lengths in metres, left and right seen along the centreline.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RoadStyle {
    pub district: District,
    pub lanes: usize,
    pub lane_width: f64,
    /// Parking lane on the left and right.
    pub parking: [bool; 2],
    /// Centreline to kerb.
    pub half_width: f64,
    pub pavement: f64,
    /// Usual speed, m/s.
    pub speed: f64,
    /// Probability that a block bends.
    pub winding: f64,
    /// Centre paint: 0 none, 1 dashed, 2 solid, 3 double.
    pub centre: u8,
    pub yellow: bool,
    pub edge_lines: bool,
}

/// Width of a parking lane.
pub(crate) const PARKING_M: f64 = 2.2;

impl RoadStyle {
    pub(crate) fn main(dice: &mut Dice, town: &Town, district: District) -> Self {
        use District::{Downtown, Industrial, Park, Rural, Suburb, Terraces};
        let lanes = match district {
            Downtown | Industrial => 1 + usize::from(dice.chance(0.5)),
            Terraces | Park => 1 + usize::from(dice.chance(0.2)),
            Suburb | Rural => 1,
        };
        let park = match district {
            Terraces => 0.75,
            Suburb | Downtown => 0.55,
            Industrial | Park => 0.35,
            Rural => 0.0,
        };
        let speed = match district {
            Suburb | Terraces => dice.range(7.0, 13.0),
            Downtown | Park => dice.range(9.0, 17.0),
            Industrial => dice.range(10.0, 19.0),
            Rural => dice.range(13.0, 21.0),
        };
        let winding = if matches!(district, Rural | Park | Suburb) { 0.65 } else { 0.3 };
        Self::finish(dice, town, district, lanes, park, speed, winding)
    }

    pub(crate) fn side(dice: &mut Dice, town: &Town, district: District) -> Self {
        let park = if matches!(district, District::Rural) { 0.0 } else { 0.45 };
        let speed = dice.range(6.0, 12.0);
        Self::finish(dice, town, district, 1, park, speed, 0.0)
    }

    fn finish(
        dice: &mut Dice,
        town: &Town,
        district: District,
        lanes: usize,
        park: f64,
        speed: f64,
        winding: f64,
    ) -> Self {
        let lane_width = dice.range(3.0, 3.6);
        let parking = [dice.chance(park), dice.chance(park)];
        let any = parking[0] || parking[1];
        let half_width = lanes as f64 * lane_width + if any { PARKING_M } else { 0.0 } + 0.35;
        let rural = matches!(district, District::Rural);
        let pavement = match district {
            District::Downtown => dice.range(2.6, 5.0),
            District::Rural => dice.range(0.0, 0.5),
            _ => dice.range(1.6, 3.2),
        };
        let centre = if lanes > 1 { 2 + dice.below(2) as u8 } else { dice.below(4) as u8 };
        let yellow = Dice::new(town.seed, &[21]).chance(0.4);
        let edge_lines = rural || dice.chance(0.3);
        Self { district, lanes, lane_width, parking, half_width, pavement, speed, winding, centre, yellow, edge_lines }
    }
}

/// A crossing as one of the two roads sees it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Crossing {
    /// Arc length of its centre.
    pub s: f64,
    /// Half width of the road that crosses.
    pub wide: f64,
    /// Zebra stripes before and after.
    pub zebra: [bool; 2],
    /// Traffic lights rather than signs.
    pub lights: bool,
    pub stop_lines: bool,
}

/// A road.
#[derive(Debug, Clone)]
pub(crate) struct Road {
    pub path: Path,
    pub style: RoadStyle,
    pub crossings: Vec<Crossing>,
    pub seed: u64,
    /// Index in the layout.
    pub index: usize,
    /// A circle around the centreline.
    pub centre: DVec2,
    pub radius: f64,
}

impl Road {
    pub(crate) fn new(seed: u64, index: usize, path: Path, style: RoadStyle) -> Self {
        let ends: Vec<DVec2> = path.pieces().iter().map(|p| p.start).chain(std::iter::once(path.end().pos)).collect();
        let (lo, hi) = ends.iter().fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(lo, hi), p| (lo.min(*p), hi.max(*p)));
        let centre = 0.5 * (lo + hi);
        // An arc bulges beyond its ends by less than a quarter of its length at the angles roads bend by.
        let bulge = path.pieces().iter().filter(|p| p.curvature != 0.0).map(|p| 0.25 * p.length).fold(0.0, f64::max);
        let radius = 0.5 * (hi - lo).length() + bulge + style.half_width;
        let seed = fold(seed, &[20, index as u64]);
        Self { path, style, crossings: Vec::new(), seed, index, centre, radius }
    }

    pub(crate) fn add_junction(&mut self, s: f64, wide: f64, main: bool, dice: &mut Dice) {
        let zebra = if matches!(self.style.district, District::Rural) { 0.1 } else { 0.5 };
        self.crossings.push(Crossing {
            s,
            wide,
            zebra: [dice.chance(zebra), dice.chance(zebra)],
            lights: dice.chance(if main { 0.5 } else { 0.2 }),
            stop_lines: dice.chance(0.8),
        });
    }

    /// Metres of the way from `s` to the edge of the nearest crossing road (negative on it).
    pub(crate) fn clear_of_crossings(&self, s: f64) -> f64 {
        self.crossings.iter().map(|c| (s - c.s).abs() - c.wide).fold(f64::INFINITY, f64::min)
    }

    /// Metres from the asphalt's edge, negative on it; infinite beside the road's ends.
    pub(crate) fn edge_distance(&self, p: DVec2) -> f64 {
        if p.distance(self.centre) > self.radius + 60.0 {
            return f64::INFINITY;
        }
        self.path.project(p).map_or(f64::INFINITY, |(_, d)| d.abs() - self.style.half_width)
    }
}
