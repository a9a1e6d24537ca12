//! How the ego moves: a speed profile along the route, and the vehicle's pose on it.
//!
//! Speed changes follow a cubic (smoothstep), so acceleration is continuous and zero at both ends of every change. The body is
//! carried by two axles on the route, which makes its yaw rate continuous where a line meets an arc.

use super::dice::Dice;
use super::layout::{Event, Layout};
use glam::{DAffine3, DMat3, DVec2, DVec3};

/// Distance between the axles, metres; the base frame sits on the ground under the rear one.
const WHEELBASE_M: f64 = 2.9;
/// Peak acceleration of a smoothstep over its mean.
const PEAK: f64 = 1.5;

/// One change of speed, or a steady stretch (`dv` = 0).
#[derive(Debug, Clone, Copy)]
struct Ramp {
    t: f64,
    s: f64,
    v: f64,
    dv: f64,
    time: f64,
}

/// Position along the route over time.
#[derive(Debug, Clone)]
pub(crate) struct Profile {
    ramps: Vec<Ramp>,
    /// Profile time of drive time 0.
    begin: f64,
}

/// Arc length, speed and acceleration at a time.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Progress {
    pub s: f64,
    pub v: f64,
    pub a: f64,
}

/// A place where the speed is given, and how long to stand there.
#[derive(Debug, Clone, Copy)]
struct Gate {
    s: f64,
    v: f64,
    dwell: f64,
    /// Highest speed on the way to the next gate.
    cruise: f64,
}

impl Profile {
    /// A profile that lasts at least `seconds` after its beginning, which lies at a random moment of a longer drive.
    pub(crate) fn new(layout: &Layout, seconds: f64) -> Self {
        let mut dice = Dice::new(layout.town.seed, &[30]);
        let begin = dice.range(6.0, 70.0);
        let hard = dice.range(1.6, 3.2);
        let mut gates = place_gates(layout, &mut dice);
        limit_speeds(&mut gates, hard);
        let mut profile = Self { ramps: Vec::new(), begin };
        let (mut t, mut s) = (0.0, gates.first().map_or(0.0, |g| g.s));
        for pair in gates.windows(2) {
            let (a, b) = (pair[0], pair[1]);
            if a.dwell > 0.0 {
                profile.steady(&mut t, &mut s, a.v, a.dwell);
            }
            profile.travel(&mut t, &mut s, a, b, hard);
            if t > begin + seconds {
                break;
            }
        }
        profile
    }

    fn steady(&mut self, t: &mut f64, s: &mut f64, v: f64, time: f64) {
        if time > 0.0 {
            self.ramps.push(Ramp { t: *t, s: *s, v, dv: 0.0, time });
            *t += time;
            *s += v * time;
        }
    }

    fn ramp(&mut self, t: &mut f64, s: &mut f64, from: f64, to: f64, time: f64) {
        if time > 0.0 {
            self.ramps.push(Ramp { t: *t, s: *s, v: from, dv: to - from, time });
            *t += time;
            *s += 0.5 * (from + to) * time;
        }
    }

    /// From gate to gate: up to a cruising speed, along, and down to the next gate's speed, meeting it exactly.
    fn travel(&mut self, t: &mut f64, s: &mut f64, a: Gate, b: Gate, hard: f64) {
        let distance = b.s - *s;
        let way = |from: f64, to: f64| 0.5 * PEAK * (to * to - from * from).abs() / hard;
        let need = |v: f64| way(a.v, v) + way(v, b.v);
        let floor = a.v.max(b.v);
        let mut v = a.cruise.max(floor);
        if need(v) > distance {
            let (mut lo, mut hi) = (floor, v);
            for _ in 0..50 {
                let mid = 0.5 * (lo + hi);
                if need(mid) > distance { hi = mid } else { lo = mid }
            }
            v = lo;
        }
        if v <= 1e-3 || distance <= 0.0 {
            return;
        }
        if need(v) > distance {
            // Too short even for a direct change (never after `limit_speeds`, but for rounding): one ramp of the right length.
            self.ramp(t, s, a.v, b.v, 2.0 * distance / (a.v + b.v).max(1e-3));
            return;
        }
        let time = |from: f64, to: f64| PEAK * (to - from).abs() / hard;
        let rest = distance - need(v);
        self.ramp(t, s, a.v, v, time(a.v, v));
        self.steady(t, s, v, rest / v);
        self.ramp(t, s, v, b.v, time(v, b.v));
    }

    pub(crate) fn at(&self, time: f64) -> Progress {
        let t = time + self.begin;
        let i = self.ramps.partition_point(|r| r.t <= t).saturating_sub(1);
        let Some(r) = self.ramps.get(i) else { return Progress { s: 0.0, v: 0.0, a: 0.0 } };
        let (u, over) = ((t - r.t).clamp(0.0, r.time), (t - r.t - r.time).max(0.0));
        let x = u / r.time;
        let v = r.v + r.dv * x * x * (3.0 - 2.0 * x);
        let s = r.s + r.v * u + r.dv * r.time * x * x * x * (1.0 - 0.5 * x);
        Progress { s: s + v * over, v, a: r.dv / r.time * 6.0 * x * (1.0 - x) }
    }
}

fn place_gates(layout: &Layout, dice: &mut Dice) -> Vec<Gate> {
    let mut gates = vec![];
    let mut cruise: f64 = 8.0;
    let keen = dice.range(0.75, 1.1);
    let mut last = 0.0;
    let mut add = |gates: &mut Vec<Gate>, gate: Gate| {
        // A gate must lie ahead of the one before; those crowded out are merged into it.
        if gates.is_empty() || gate.s > last + 0.5 {
            last = gate.s;
            gates.push(gate);
        } else if let Some(g) = gates.last_mut() {
            g.v = g.v.min(gate.v);
            g.cruise = gate.cruise;
            g.dwell = g.dwell.max(gate.dwell);
        }
    };
    for event in &layout.events {
        match *event {
            Event::Limit { s, speed } => {
                let next = speed * keen;
                add(&mut gates, Gate { s, v: cruise.min(next), dwell: 0.0, cruise: next });
                cruise = next;
                if dice.chance(0.12) {
                    let dwell = dice.range(1.0, 5.0);
                    add(&mut gates, Gate { s: s + dice.range(8.0, 20.0), v: 0.0, dwell, cruise });
                }
            }
            Event::Cross { stop, s } => {
                if dice.chance(0.35) {
                    let dwell = dice.range(2.0, 9.0);
                    add(&mut gates, Gate { s: stop, v: 0.0, dwell, cruise });
                } else if dice.chance(0.3) {
                    add(&mut gates, Gate { s, v: cruise * 0.6, dwell: 0.0, cruise });
                }
            }
            Event::Turn { stop, from, to, radius } => {
                let slow = (dice.range(1.4, 2.4) * radius).sqrt();
                if dice.chance(0.4) {
                    let dwell = dice.range(1.0, 8.0);
                    add(&mut gates, Gate { s: stop, v: 0.0, dwell, cruise: slow });
                }
                add(&mut gates, Gate { s: from, v: slow, dwell: 0.0, cruise: slow });
                add(&mut gates, Gate { s: to, v: slow, dwell: 0.0, cruise: slow });
                cruise = slow;
            }
        }
    }
    gates
}

/// Lowers gate speeds until each gate can be reached from the one before with accelerations up to `hard`.
fn limit_speeds(gates: &mut [Gate], hard: f64) {
    let reach = |v: f64, way: f64| (v * v + way.max(0.0) * hard / (0.5 * PEAK)).sqrt();
    for i in (1..gates.len()).rev() {
        let way = gates[i].s - gates[i - 1].s;
        gates[i - 1].v = gates[i - 1].v.min(reach(gates[i].v, way));
    }
    for i in 1..gates.len() {
        let way = gates[i].s - gates[i - 1].s;
        gates[i].v = gates[i].v.min(reach(gates[i - 1].v, way));
    }
}

/// A vehicle's frame on a path: origin on the ground under the rear axle.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ride {
    pub pos: DVec2,
    pub yaw: f64,
    pub vel: DVec2,
    pub yaw_rate: f64,
}

/// The frame of a vehicle whose rear axle is at `s` and moves at `v` along the path, its front axle `wheelbase` ahead on it.
pub(crate) fn ride(path: &super::path::Path, s: f64, v: f64, wheelbase: f64) -> Ride {
    let rear = path.at(s);
    let vel = rear.dir() * v;
    if wheelbase <= 0.0 {
        return Ride { pos: rear.pos, yaw: rear.heading, vel, yaw_rate: rear.curvature * v };
    }
    let front = path.at(s + wheelbase);
    let chord = front.pos - rear.pos;
    let swing = (front.dir() - rear.dir()) * v;
    Ride { pos: rear.pos, yaw: chord.y.atan2(chord.x), vel, yaw_rate: chord.perp_dot(swing) / chord.length_squared() }
}

/// Heave and pitch of the springs, seeded.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Springs {
    phase: [f64; 4],
    size: f64,
}

impl Springs {
    pub(crate) fn new(seed: u64) -> Self {
        let mut dice = Dice::new(seed, &[31]);
        Self { phase: std::array::from_fn(|_| dice.range(0.0, std::f64::consts::TAU)), size: dice.range(0.3, 1.2) }
    }

    /// local_from_base at a time.
    pub(crate) fn pose(&self, layout: &Layout, profile: &Profile, time: f64) -> DAffine3 {
        let p = profile.at(time);
        let ride = ride(&layout.route, p.s, p.v, WHEELBASE_M);
        // Bumps belong to the road, so they are a function of the way, not of time: nothing shakes at a standstill.
        let [a, b, c, d] = self.phase;
        let bump = |period: f64, phase: f64| (p.s * std::f64::consts::TAU / period + phase).sin() * self.size;
        let height = 0.006 * bump(7.3, a) + 0.012 * bump(23.0, b);
        let pitch = 0.0022 * bump(11.0, c) - 0.004 * p.a;
        let roll = 0.003 * bump(17.0, d) + 0.004 * ride.yaw_rate * p.v;
        // z up, y left: a positive angle about y lowers the nose.
        let rotation = DMat3::from_rotation_z(ride.yaw) * DMat3::from_rotation_y(pitch) * DMat3::from_rotation_x(roll);
        DAffine3::from_mat3_translation(rotation, DVec3::new(ride.pos.x, ride.pos.y, height))
    }
}
