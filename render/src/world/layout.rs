//! The street plan: legs (the roads the ego drives along, from turn to turn), the side roads that cross them, and the route.
//!
//! Turns alternate between left and right, so that the route climbs like a staircase: it cannot meet itself, however long.

use super::dice::Dice;
use super::path::Path;
use super::road::{District, Road, RoadStyle};
use glam::DVec2;
use std::f64::consts::{FRAC_PI_2, PI};

/// Straight metres on both sides of every junction: room for the ego's turning arc.
const APPROACH_M: f64 = 26.0;
/// A leg's road goes on straight beyond the turn at its end by this much (unless it ends there in a T).
const STUB_M: f64 = 110.0;

/// What holds all over one drive.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Town {
    pub seed: u64,
    /// 1 where one drives on the right, -1 on the left.
    pub hand: f64,
    pub district: District,
    /// Height of everything beside the asphalt, metres.
    pub kerb: f64,
    /// Radius of the kerb at street corners, metres.
    pub corner: f64,
    pub traffic: f64,
}

/// Where two roads cross.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Junction {
    pub pos: DVec2,
    /// Index of the crossing road.
    pub other: usize,
}

/// One leg: its own road and what crosses it.
#[derive(Debug, Clone)]
pub(crate) struct Leg {
    pub road: usize,
    /// Roads that belong to this leg: its own and its side roads, `road..roads_end`.
    pub roads_end: usize,
    pub junctions: Vec<Junction>,
    /// The lane the ego takes, metres left of the centreline.
    pub lane: f64,
    /// Where the leg begins on the route.
    pub route_s: f64,
}

/// A place on the route that the ego's speed depends on.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Event {
    /// From here on the road allows this speed.
    Limit { s: f64, speed: f64 },
    /// A crossing the route goes straight over; one may have to stop at `stop`.
    Cross { stop: f64, s: f64 },
    /// A turning arc.
    Turn { stop: f64, from: f64, to: f64, radius: f64 },
}

/// The plan.
#[derive(Debug, Clone)]
pub(crate) struct Layout {
    pub town: Town,
    pub roads: Vec<Road>,
    pub legs: Vec<Leg>,
    pub route: Path,
    pub events: Vec<Event>,
}

/// One leg before the roads are joined.
struct Draft {
    core: Path,
    /// Centreline arc length and piece count at each block's end.
    blocks: Vec<(f64, usize)>,
    style: RoadStyle,
    /// Lane the ego takes, metres left of the centreline.
    lane: f64,
    turn: f64,
    stubs: (f64, f64),
}

impl Layout {
    /// Roads enough for a route of `length` metres.
    pub(crate) fn new(town: Town, length: f64) -> Self {
        let drafts = draft_legs(&town, length);
        let mut layout =
            Self { town, roads: Vec::new(), legs: Vec::new(), route: Path::new(DVec2::ZERO, 0.0), events: Vec::new() };
        for (i, draft) in drafts.iter().enumerate() {
            layout.add_leg(i, draft);
        }
        layout.join_legs(&drafts);
        layout.lay_route(&drafts);
        layout
    }

    /// The leg under route position `s`.
    pub(crate) fn leg_at(&self, route_s: f64) -> usize {
        self.legs.partition_point(|leg| leg.route_s <= route_s).saturating_sub(1)
    }

    /// Indices of the roads of the legs around leg `leg`.
    pub(crate) fn roads_near(&self, leg: usize, reach: usize) -> std::ops::Range<usize> {
        let (lo, hi) = (leg.saturating_sub(reach), (leg + reach).min(self.legs.len().saturating_sub(1)));
        match (self.legs.get(lo), self.legs.get(hi)) {
            (Some(a), Some(b)) => a.road..b.roads_end,
            _ => 0..0,
        }
    }

    fn add_leg(&mut self, index: usize, draft: &Draft) {
        let road = self.roads.len();
        let first = draft.core.at(0.0);
        let (before, after) = draft.stubs;
        let mut path = Path::new(first.pos - first.dir() * before, first.heading);
        path.push(before, 0.0);
        draft.core.pieces().iter().for_each(|p| path.push(p.length, p.curvature));
        path.push(after, 0.0);
        self.roads.push(Road::new(self.town.seed, road, path, draft.style));
        let mut junctions = Vec::new();
        let inner = draft.blocks.len().saturating_sub(1);
        for (b, (s, _)) in draft.blocks[..inner].iter().enumerate() {
            let mut dice = Dice::new(self.town.seed, &[11, index as u64, b as u64]);
            let at = draft.core.at(*s);
            let heading = at.heading + FRAC_PI_2 + dice.range(-0.2, 0.2);
            let arms = [dice.range(60.0, 130.0), dice.range(60.0, 130.0)];
            let arms = match dice.below(5) {
                0 => [0.0, arms[1]],
                1 => [arms[0], 0.0],
                _ => arms,
            };
            let dir = DVec2::from_angle(heading);
            let mut path = Path::new(at.pos - dir * arms[0], heading);
            path.push(arms[0] + arms[1], 0.0);
            let style = RoadStyle::side(&mut dice, &self.town, draft.style.district);
            let other = self.roads.len();
            let mut side = Road::new(self.town.seed, other, path, style);
            side.add_junction(arms[0], draft.style.half_width, false, &mut dice);
            let s = s + before;
            self.roads[road].add_junction(s, style.half_width, true, &mut dice);
            self.roads.push(side);
            junctions.push(Junction { pos: at.pos, other });
        }
        self.legs.push(Leg { road, roads_end: self.roads.len(), junctions, lane: draft.lane, route_s: 0.0 });
    }

    /// Tells every leg's road about the next leg's, which it crosses at its end.
    fn join_legs(&mut self, drafts: &[Draft]) {
        for i in 1..drafts.len() {
            let mut dice = Dice::new(self.town.seed, &[12, i as u64]);
            let (a, b) = (&drafts[i - 1], &drafts[i]);
            let (ra, rb) = (self.legs[i - 1].road, self.legs[i].road);
            let (sa, sb) = (a.stubs.0 + a.core.length(), b.stubs.0);
            self.roads[ra].add_junction(sa, b.style.half_width, true, &mut dice);
            self.roads[rb].add_junction(sb, a.style.half_width, true, &mut dice);
            let pos = a.core.end().pos;
            self.legs[i - 1].junctions.push(Junction { pos, other: rb });
        }
    }

    /// The ego's lane from leg to leg, joined by turning arcs.
    fn lay_route(&mut self, drafts: &[Draft]) {
        let Some(first) = drafts.first() else { return };
        let start = first.core.at(0.0);
        let mut route = Path::new(start.pos + start.left() * first.lane, start.heading);
        let mut cut = 0.0; // metres of the leg's first line that the arc before it has used up
        for (i, draft) in drafts.iter().enumerate() {
            self.legs[i].route_s = route.length();
            let limit = |curvature: f64| {
                if curvature == 0.0 { draft.style.speed } else { draft.style.speed.min((2.4 / curvature.abs()).sqrt()) }
            };
            let lane = draft.core.offset(draft.lane);
            let join = drafts.get(i + 1).map(|next| Join::new(&self.town, draft, next));
            let last = lane.pieces().len().saturating_sub(1);
            let mut block = 0;
            for (k, piece) in lane.pieces().iter().enumerate() {
                let mut length = piece.length;
                if k == 0 {
                    length -= cut;
                }
                if let (true, Some(join)) = (k == last, &join) {
                    length = join.straight_to - (piece.length - length);
                }
                self.events.push(Event::Limit { s: route.length(), speed: limit(piece.curvature) });
                route.push(length, piece.curvature);
                let inner = draft.blocks.len().saturating_sub(1);
                if block < inner && draft.blocks[block].1 == k + 1 {
                    let junction = self.legs[i].junctions[block];
                    let wide = self.roads[junction.other].style.half_width;
                    // The lane crosses the side road's centreline beside the junction's centre: near enough for a stop line.
                    let s = route.length();
                    self.events.push(Event::Cross { stop: s - wide - self.town.corner - 6.5, s });
                    block += 1;
                }
            }
            if let Some(join) = join {
                let from = route.length();
                route.push(join.arc, join.turn.signum() / join.radius);
                let to = route.length();
                let stop = from - 3.0;
                self.events.push(Event::Turn { stop, from, to, radius: join.radius });
                cut = join.cut_next;
            }
        }
        self.route = route;
    }
}

/// The arc between two legs' lanes.
struct Join {
    turn: f64,
    radius: f64,
    arc: f64,
    /// Metres of the first leg's last line before the arc.
    straight_to: f64,
    /// Metres of the next leg's first line that the arc replaces.
    cut_next: f64,
}

impl Join {
    fn new(town: &Town, a: &Draft, b: &Draft) -> Self {
        let (lane_a, lane_b) = (a.core.offset(a.lane), b.core.offset(b.lane));
        let (end_a, start_b) = (lane_a.end(), lane_b.at(0.0));
        let (ta, tb) = (end_a.dir(), start_b.dir());
        let turn = ta.perp_dot(tb).atan2(ta.dot(tb));
        // Where the two lane lines meet: from the end of a, `along` metres further (may be negative).
        let gap = start_b.pos - end_a.pos;
        let along = gap.perp_dot(tb) / ta.perp_dot(tb);
        let meet = end_a.pos + ta * along;
        let before_b = (meet - start_b.pos).dot(tb);
        // A turn to the kerb's side follows the corner; the other one crosses the junction in a wide arc.
        let tight = turn * town.hand < 0.0;
        let inner = |draft: &Draft| draft.style.half_width - draft.lane.abs();
        let radius = if tight {
            // Never nearer to the rounded kerb than the nearer of the two lanes is to its own.
            town.corner + inner(a).max(inner(b))
        } else {
            town.corner + a.style.half_width.min(b.style.half_width) + 1.5
        };
        let radius = radius.clamp(5.0, 14.0);
        let tangent = radius * (0.5 * turn.abs()).tan();
        let last = lane_a.pieces().last().map_or(0.0, |p| p.length);
        Self {
            turn,
            radius,
            arc: radius * turn.abs(),
            straight_to: last + along - tangent,
            cut_next: before_b + tangent,
        }
    }
}

fn draft_legs(town: &Town, length: f64) -> Vec<Draft> {
    let mut drafts: Vec<Draft> = Vec::new();
    let mut dice = Dice::new(town.seed, &[10]);
    let base = dice.range(-PI, PI);
    let staircase = dice.sign() as i32;
    let (mut nominal, mut start, mut heading) = (0i32, DVec2::ZERO, base);
    let mut total = 0.0;
    let mut back_stub = STUB_M + 120.0;
    while total < length || drafts.len() < 2 {
        let i = drafts.len() as u64;
        let mut dice = Dice::new(town.seed, &[13, i]);
        let district = if dice.chance(0.6) { town.district } else { District::roll(&mut dice) };
        let style = RoadStyle::main(&mut dice, town, district);
        let mut core = Path::new(start, heading);
        let mut blocks = Vec::new();
        for _ in 0..1 + dice.below(4) {
            let nominal_heading = base + f64::from(nominal) * FRAC_PI_2;
            let off = wrap(core.end().heading - nominal_heading);
            if dice.chance(style.winding) {
                let side = if off.abs() > 0.15 { -off.signum() } else { dice.sign() };
                // Bends take the road off its nominal heading and then back to it.
                let angle =
                    if off.abs() > 0.15 { (off.abs() + dice.range(-0.1, 0.1)).min(0.6) } else { dice.range(0.12, 0.5) };
                let radius = dice.range(45.0, 180.0);
                core.push(APPROACH_M + dice.range(0.0, 30.0), 0.0);
                core.push(radius * angle, side / radius);
                core.push(APPROACH_M + dice.range(0.0, 30.0), 0.0);
            } else {
                core.push(2.0 * APPROACH_M + dice.range(8.0, 90.0), 0.0);
            }
            blocks.push((core.length(), core.pieces().len()));
        }
        // To one side and back, always the same: headings stay within a right angle of the diagonal between (bends included).
        let turn = if nominal == 0 { staircase } else { -nominal };
        let end = core.end();
        let off = wrap(end.heading - base - f64::from(nominal) * FRAC_PI_2);
        nominal += turn;
        let next = end.heading + f64::from(turn) * FRAC_PI_2 - 0.3 * off + dice.range(-0.1, 0.1);
        total += core.length();
        let ahead = if dice.chance(0.3) { 0.0 } else { STUB_M };
        // In a T the leg's road ends at the middle of the next one, or begins there.
        let stubs = (back_stub, ahead);
        back_stub = if ahead > 0.0 && dice.chance(0.3) { 0.0 } else { STUB_M };
        // Turning across traffic starts from the inner lane, the other way from the outer one.
        let k = if f64::from(turn) * town.hand > 0.0 { 0 } else { style.lanes - 1 };
        let lane = -town.hand * (k as f64 + 0.5) * style.lane_width;
        drafts.push(Draft { core, blocks, style, lane, turn: next - end.heading, stubs });
        (start, heading) = (end.pos, next);
    }
    debug_assert!(drafts.iter().all(|d| d.turn.is_finite()));
    drafts
}

fn wrap(angle: f64) -> f64 {
    (angle + PI).rem_euclid(2.0 * PI) - PI
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(crate) fn town(seed: u64) -> Town {
        Town { seed, hand: 1.0, district: District::Suburb, kerb: 0.1, corner: 4.0, traffic: 1.0 }
    }

    #[test]
    fn the_route_is_smooth_stays_on_asphalt_and_never_meets_itself() {
        for seed in 0..8 {
            let layout = Layout::new(Town { hand: if seed % 2 == 0 { 1.0 } else { -1.0 }, ..town(seed) }, 3000.0);
            let route = &layout.route;
            assert!(route.length() >= 2000.0);
            for pair in route.pieces().windows(2) {
                let end = pair[0].start.distance(pair[1].start);
                assert!(end <= pair[0].length + 1e-9 && pair[0].length > 0.0);
            }
            let mut far = Vec::new();
            for k in 0..(route.length() / 2.0) as usize {
                let p = route.at(k as f64 * 2.0).pos;
                let s = 2.0 * k as f64;
                let ground = crate::world::ground::Ground::new(&layout, layout.leg_at(s), p.extend(1.5));
                // Inside the union of two roads `edge` is a bound only: look at a circle as wide as the ego instead.
                for j in 0..24 {
                    let p = glam::Vec2::from_angle(j as f32 * 0.2618) * 0.95;
                    let edge = ground.spot(p).edge;
                    assert!(edge < 0.0, "seed {seed}: a wheel is {edge} m off the asphalt at {s} m");
                }
                if k % 10 == 0 {
                    far.push((k, p));
                }
            }
            for (i, (ka, a)) in far.iter().enumerate() {
                for (kb, b) in &far[i + 1..] {
                    assert!(
                        kb - ka < 40 || a.distance(*b) > 30.0,
                        "seed {seed}: the route comes back to itself: {} m and {} m, {a} {b}",
                        2 * ka,
                        2 * kb
                    );
                }
            }
        }
    }
}
