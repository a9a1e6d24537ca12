//! Which streams a leg has, who of them may exist (nobody drives through the ego or across a taken junction), and the cars that
//! drive with the ego.

use super::dice::{Dice, fold};
use super::ego::{Profile, ride};
use super::layout::{Layout, Leg};
use super::path::Path;
use super::road::{District, PARKING_M, Road};
use super::stream::{Actor, Crowd, Footprint, Model, Pace, Stream};
use super::vehicles::VehicleModel;
use glam::DVec2;
use std::f64::consts::{PI, TAU};

/// Instance numbers: the first few for the ego's companions, then one block per leg, which comes round after [`ID_LEGS`] legs.
const ID_LEG_FIRST: u32 = 16;
const ID_LEG: u32 = 2180;
const ID_LEGS: u32 = 30;
/// Numbers of one stream: more than fit into the 520 m a scene spans (on side roads: into their length).
const ID_MAIN: u32 = 48;
const ID_SIDE: u32 = 24;
const ID_PEOPLE_MAIN: u32 = 120;
const ID_PEOPLE_SIDE: u32 = 60;
/// Pedestrians of one stream keep this far apart.
const PEOPLE_APART_M: f64 = 4.8;
/// Numbers for parked vehicles at the end of a leg's block.
pub(crate) const ID_PARKED: u32 = 420;

/// First instance number for the parked vehicles of a leg.
pub(crate) fn parked_ids(leg: usize) -> u32 {
    ID_LEG_FIRST + (leg as u32 % ID_LEGS) * ID_LEG + ID_LEG - ID_PARKED
}

/// Seconds kept free before and after somebody who has right of way.
const GAP_SEC: f64 = 2.2;
/// Metres kept free around the ego and its companions.
const CLEAR_M: f64 = 0.45;

/// A stream and those it must give way to: where on the other's path, and at which of its own positions.
#[derive(Debug, Clone)]
pub(crate) struct Flow {
    pub stream: Stream,
    gives_way: Vec<GiveWay>,
}

#[derive(Debug, Clone, Copy)]
struct GiveWay {
    /// Index among the leg's flows.
    other: usize,
    own_s: f64,
    other_s: f64,
}

/// All streams of a leg, the leg's own road first.
pub(crate) fn leg_flows(layout: &Layout, index: usize) -> Vec<Flow> {
    let Some(leg) = layout.legs.get(index) else { return Vec::new() };
    let mut id = ID_LEG_FIRST + (index as u32 % ID_LEGS) * ID_LEG;
    let mut streams = Vec::new();
    main_streams(layout, leg, &mut id, &mut streams);
    let mut flows: Vec<Flow> = streams.into_iter().map(|stream| Flow { stream, gives_way: Vec::new() }).collect();
    let along = flows.len();
    add_crossers(layout, leg, &mut id, &mut flows, along);
    for side in leg.road + 1..leg.roads_end {
        let mut streams = Vec::new();
        side_streams(layout, &layout.roads[side], &mut id, &mut streams);
        let junction = leg.junctions.iter().find(|j| j.other == side);
        for stream in streams {
            let gives_way = junction.map_or_else(Vec::new, |j| meetings(&flows[..along], &stream, j.pos));
            flows.push(Flow { stream, gives_way });
        }
    }
    flows
}

/// Where a stream that crosses the leg's road at `pos` meets each stream along it.
fn meetings(along: &[Flow], stream: &Stream, pos: DVec2) -> Vec<GiveWay> {
    let Some((own, _)) = stream.path.project(pos) else { return Vec::new() };
    let meet = |(other, flow): (usize, &Flow)| {
        let (other_s, d) = flow.stream.path.project(pos)?;
        // The other's line passes `d` beside the crossing's centre: how far before or after it on one's own path?
        let nearest = flow.stream.path.at(other_s).pos;
        let own_s = stream.path.project(nearest).map_or(own, |(s, _)| s);
        (d.abs() < 60.0).then_some(GiveWay { other, own_s, other_s })
    };
    along.iter().enumerate().filter_map(meet).collect()
}

fn vehicles(dice: &mut Dice, layout: &Layout, path: Path, speed: f64, share: f64) -> Stream {
    let v = speed * dice.range(0.6, 1.05);
    // Half of the streams keep their speed, the others slow down and speed up again and again.
    let a = if dice.chance(0.5) { 0.0 } else { v * dice.range(0.2, 0.6) };
    let w = TAU / dice.range(9.0, 20.0);
    let pace = Pace { v, a, w, phase: dice.range(0.0, TAU) };
    let big = dice.range(0.05, 0.3);
    Stream {
        crowd: Crowd::Vehicles { big },
        path,
        pace,
        // Far enough apart to keep a lorry's length and more between rear axles where the stream is slowest.
        interval: (17.0 / (v - a)).max(2.4) * dice.range(1.34, 1.8),
        share: share * layout.town.traffic,
        seed: dice.next(),
        id: 0,
        ids: 1,
        height: 0.0,
        dips: Vec::new(),
    }
}

fn number(stream: Stream, id: &mut u32, ids: u32, streams: &mut Vec<Stream>) {
    streams.push(Stream { id: *id, ids, ..stream });
    *id += ids;
}

fn busy(district: District) -> (f64, f64, f64) {
    match district {
        District::Downtown => (0.9, 0.45, 0.8),
        District::Terraces => (0.85, 0.45, 0.6),
        District::Suburb => (0.8, 0.4, 0.5),
        District::Park => (0.8, 0.6, 0.6),
        District::Industrial => (0.9, 0.3, 0.35),
        District::Rural => (0.85, 0.35, 0.2),
    }
}

fn main_streams(layout: &Layout, leg: &Leg, id: &mut u32, streams: &mut Vec<Stream>) {
    let road = &layout.roads[leg.road];
    let style = &road.style;
    let hand = layout.town.hand;
    let mut dice = Dice::new(road.seed, &[40]);
    let (cars, bikes, people) = busy(style.district);
    for direction in [1.0, -1.0] {
        for lane in 0..style.lanes {
            let lateral = -hand * direction * (lane as f64 + 0.5) * style.lane_width;
            if (lateral - leg.lane).abs() < 0.5 {
                continue;
            }
            let path = road.path.offset(lateral);
            let path = if direction < 0.0 { path.reversed() } else { path };
            number(vehicles(&mut dice, layout, path, style.speed, cars), id, ID_MAIN, streams);
        }
        let lateral = -hand * direction * (style.lanes as f64 * style.lane_width + 0.05);
        number(cyclists(&mut dice, layout, road, lateral, direction, bikes), id, ID_MAIN, streams);
    }
    pedestrians(&mut dice, layout, road, people, id, ID_PEOPLE_MAIN, streams);
}

fn side_streams(layout: &Layout, road: &Road, id: &mut u32, streams: &mut Vec<Stream>) {
    let style = &road.style;
    let mut dice = Dice::new(road.seed, &[41]);
    let (cars, _, people) = busy(style.district);
    for direction in [1.0, -1.0] {
        let lateral = -layout.town.hand * direction * 0.5 * style.lane_width;
        let path = road.path.offset(lateral);
        let path = if direction < 0.0 { path.reversed() } else { path };
        // A road that ends at the junction has traffic that could only come out of it in a turn: none.
        let through = road.crossings.iter().all(|c| c.s > 1.0 && c.s < road.path.length() - 1.0);
        let share = if through { 0.9 * cars } else { 0.0 };
        number(vehicles(&mut dice, layout, path, style.speed, share), id, ID_SIDE, streams);
    }
    pedestrians(&mut dice, layout, road, 0.6 * people, id, ID_PEOPLE_SIDE, streams);
}

fn cyclists(dice: &mut Dice, layout: &Layout, road: &Road, lateral: f64, direction: f64, share: f64) -> Stream {
    let path = road.path.offset(lateral);
    let path = if direction < 0.0 { path.reversed() } else { path };
    let v = dice.range(3.0, 6.5);
    let a = if dice.chance(0.5) { 0.0 } else { 0.3 * v };
    Stream {
        crowd: Crowd::Cyclists,
        path,
        pace: Pace { v, a, w: TAU / dice.range(6.0, 12.0), phase: dice.range(0.0, TAU) },
        interval: dice.range(4.0, 9.0),
        share: share * layout.town.traffic,
        seed: dice.next(),
        id: 0,
        ids: 1,
        height: 0.0,
        dips: Vec::new(),
    }
}

/// Both pavements, both directions, each on its own line.
fn pedestrians(
    dice: &mut Dice,
    layout: &Layout,
    road: &Road,
    share: f64,
    id: &mut u32,
    ids: u32,
    streams: &mut Vec<Stream>,
) {
    let style = &road.style;
    for side in [1.0, -1.0] {
        let walk = style.pavement.max(1.0);
        for (k, direction) in [(0.4, 1.0), (0.78, -1.0)] {
            let lateral = side * (style.half_width + k * walk + 0.25);
            let path = road.path.offset(lateral);
            let path = if direction < 0.0 { path.reversed() } else { path };
            let dips = road.crossings.iter().filter_map(|c| {
                let (s, _) = path.project(road.path.at(c.s).pos)?;
                let wide = c.wide + 0.6 * layout.town.corner;
                Some((s - wide, s + wide))
            });
            let dips = dips.collect();
            let v = dice.range(0.8, 1.9);
            let stream = Stream {
                crowd: Crowd::Pedestrians,
                path,
                pace: Pace::steady(v),
                interval: dice.range(1.0, 2.2) * PEOPLE_APART_M / v,
                share: share * layout.town.traffic,
                seed: dice.next(),
                id: 0,
                ids: 1,
                height: layout.town.kerb,
                dips,
            };
            number(stream, id, ids, streams);
        }
    }
}

/// Pedestrians who cross the leg's road, at zebras and elsewhere.
fn add_crossers(layout: &Layout, leg: &Leg, id: &mut u32, flows: &mut Vec<Flow>, along: usize) {
    let road = &layout.roads[leg.road];
    let mut dice = Dice::new(road.seed, &[42]);
    let (_, _, people) = busy(road.style.district);
    let mut places: Vec<f64> = Vec::new();
    for c in &road.crossings {
        for (before, zebra) in [(-1.0, c.zebra[0]), (1.0, c.zebra[1])] {
            if zebra {
                places.push(c.s + before * (c.wide + zebra_from(layout.town.corner) + 0.5 * ZEBRA_M));
            }
        }
    }
    for _ in 0..2 {
        places.push(dice.range(0.2, 0.8) * road.path.length());
    }
    for s in places.into_iter().take(7) {
        let at = road.path.at(s);
        let reach = road.style.half_width + road.style.pavement + 9.0;
        let direction = dice.sign();
        let heading = at.heading + direction * 0.5 * PI;
        let mut path = Path::new(at.pos - DVec2::from_angle(heading) * reach, heading);
        path.push(2.0 * reach, 0.0);
        let wide = road.style.half_width;
        let stream = Stream {
            crowd: Crowd::Pedestrians,
            path,
            pace: Pace::steady(dice.range(1.0, 2.0)),
            interval: dice.range(3.5, 8.0),
            share: (1.2 * people * layout.town.traffic).min(0.9),
            seed: dice.next(),
            id: *id,
            ids: ID_SIDE,
            height: layout.town.kerb,
            dips: vec![(reach - wide, reach + wide)],
        };
        *id += ID_SIDE;
        let mut gives_way = meetings(&flows[..along], &stream, at.pos);
        gives_way.retain(|g| !matches!(flows[g.other].stream.crowd, Crowd::Pedestrians));
        flows.push(Flow { stream, gives_way });
    }
}

/// From the crossing road's edge to the zebra, and the zebra's length along the road.
pub(crate) fn zebra_from(corner: f64) -> f64 {
    0.6 * corner + 1.0
}
pub(crate) const ZEBRA_M: f64 = 3.0;

impl Flow {
    /// Whether a slot may exist at all: taken, nobody with right of way in its way, and never through the ego's convoy.
    pub(crate) fn exists(&self, slot: i64, flows: &[Flow], convoy: &Convoy, seconds: f64) -> bool {
        let stream = &self.stream;
        let blocked = |g: &GiveWay| {
            let time = stream.time_at(slot, g.own_s);
            flows.get(g.other).is_some_and(|o| o.stream.passes(g.other_s, time, GAP_SEC))
        };
        stream.taken(slot) && !self.gives_way.iter().any(blocked) && !self.meets_convoy(slot, convoy, seconds)
    }

    /// Steps through the slot's life, in strides no faster than the two could close the distance between them.
    fn meets_convoy(&self, slot: i64, convoy: &Convoy, seconds: f64) -> bool {
        let stream = &self.stream;
        let from = stream.time_at(slot, 0.0).max(-1.0);
        let to = stream.time_at(slot, stream.path.length()).min(seconds + 1.0);
        (0..convoy.members()).any(|member| {
            let mut time = from;
            while time <= to {
                let (mine, theirs) = (stream.actor(slot, time).footprint(CLEAR_M), convoy.footprint(member, time));
                if mine.overlaps(&theirs) {
                    return true;
                }
                let gap = mine.centre.distance(theirs.centre) - mine.half.length() - theirs.half.length();
                time += (gap / (stream.pace.top() + Convoy::TOP_MPS)).max(0.2);
            }
            false
        })
    }
}

/// The ego and the cars before and behind it on its own route: each drives as the ego does, some seconds earlier or later.
#[derive(Debug, Clone)]
pub(crate) struct Convoy {
    pub route: Path,
    pub profile: Profile,
    companions: Vec<Companion>,
}

#[derive(Debug, Clone, Copy)]
struct Companion {
    model: VehicleModel,
    /// Seconds ahead of the ego (negative behind), swinging slowly; the way ahead at least.
    ahead: f64,
    swing: f64,
    w: f64,
    phase: f64,
    gap: f64,
}

impl Convoy {
    /// No faster than this on the route, m/s (companions swing ahead of the ego's own pace).
    const TOP_MPS: f64 = 36.0;
    /// How far ahead of the ego, in seconds, a companion can be.
    pub(crate) const AHEAD_MAX_SEC: f64 = 24.0;

    pub(crate) fn new(seed: u64, route: Path, profile: Profile, traffic: f64) -> Self {
        let mut dice = Dice::new(seed, &[45]);
        let mut companions = Vec::new();
        for sign in [1.0, -1.0] {
            let count = if dice.chance((0.7 * traffic).min(0.95)) { 1 + dice.below(3) } else { 0 };
            let (mut ahead, mut gap) = (dice.range(0.5, 3.5), 0.0);
            for _ in 0..count {
                let model = VehicleModel::roll(&mut dice, 0.2);
                gap += f64::from(model.length) + dice.range(3.5, 6.0);
                let w = TAU / dice.range(30.0, 70.0);
                // Amplitude and rate keep every companion's speed positive: |d ahead / dt| < 0.45. Neighbours on one side
                // swing apart by less than their spacing in time and the gap in metres together.
                let swing = dice.range(0.0, 0.4 / w).min(0.9 * ahead).min(1.5);
                companions.push(Companion {
                    model,
                    ahead: sign * ahead,
                    swing,
                    w,
                    phase: dice.range(0.0, TAU),
                    gap: sign * gap,
                });
                ahead += 1.5 + 1.5 + dice.range(0.5, 2.5);
            }
        }
        Self { route, profile, companions }
    }

    pub(crate) fn members(&self) -> usize {
        1 + self.companions.len()
    }

    /// Whether somebody who is `actor(time)` keeps clear of the ego and its companions from `from` to `to`, seconds.
    pub(crate) fn clear_of(&self, (from, to): (f64, f64), actor: impl Fn(f64) -> Actor) -> bool {
        let steps = ((to - from) / 0.1).ceil().max(0.0) as usize;
        (0..=steps).all(|k| {
            let time = from + 0.1 * k as f64;
            let own = actor(time).footprint(2.0 * CLEAR_M);
            (0..self.members()).all(|member| !own.overlaps(&self.footprint(member, time)))
        })
    }

    /// The ego's companions at a time.
    pub(crate) fn actors(&self, time: f64) -> impl Iterator<Item = Actor> + '_ {
        (0..self.companions.len()).map(move |i| self.actor(i, time))
    }

    pub(crate) fn actor(&self, i: usize, time: f64) -> Actor {
        let c = &self.companions[i];
        let (shift, rate) =
            (c.ahead + c.swing * (c.w * time + c.phase).sin(), c.swing * c.w * (c.w * time + c.phase).cos());
        let p = self.profile.at(time + shift);
        let (s, v) = (p.s + c.gap, p.v * (1.0 + rate));
        let ride = ride(&self.route, s, v, f64::from(c.model.wheelbase));
        Actor {
            id: fold(0xc0, &[i as u64]),
            instance: 1 + i as u16,
            model: Model::Vehicle(c.model),
            pos: ride.pos.extend(0.0),
            yaw: ride.yaw,
            vel: ride.vel.extend(0.0),
            yaw_rate: ride.yaw_rate,
            way: s,
            speed: v,
        }
    }

    fn footprint(&self, member: usize, time: f64) -> Footprint {
        if let Some(i) = member.checked_sub(1) {
            return self.actor(i, time).footprint(CLEAR_M);
        }
        let p = self.profile.at(time);
        let ride = ride(&self.route, p.s, p.v, 2.9);
        let dir = DVec2::from_angle(ride.yaw);
        Footprint { centre: ride.pos + dir * 1.4, dir, half: DVec2::new(2.4, 0.95) + DVec2::splat(CLEAR_M) }
    }
}

/// Middle of the parking lane beside the outer driving lane, metres from the centreline.
pub(crate) fn parking_lateral(road: &Road) -> f64 {
    road.style.half_width - 0.5 * PARKING_M
}
