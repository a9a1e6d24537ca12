//! Where and when a window is: far origins, odd clocks, strides, baselines, headings, lenses.

use anyhow::Result;
use glam::{DQuat, DVec3};
use storm_render::Intrinsics;

use super::subject::{Subject, apart, nonfinite, refused};
use super::{Case, Finding, Sheet};
use crate::rigid::Rigid;
use crate::source::Frame;
use crate::window::PosedSet;

/// The same window elsewhere differs by what rounding its poses costs: f64 at 1e7 m is 2e-9 m, an f32 pose inside the
/// window 1e-7 of its size, and the network passes that on, somewhat larger.
const MOVED: f64 = 1e-4;
/// f32 against f64 through the whole network, on windows as a vehicle sees them.
pub const F32: f64 = 2e-3;

const STRIDE_SEC: f64 = 0.5;

pub fn run(subject: &mut Subject, found: &mut dyn FnMut(Case)) -> Result<()> {
    let sets = subject.sets.clone();
    let cameras = subject.cameras.clone();
    let window = subject.plain_window()?;
    let (base, _) = subject.step(&window, &cameras)?;

    let mut sheet =
        Sheet { group: "place and time", against: "the same window at the origin, relative", limit: MOVED, found };
    let mut moved = |subject: &mut Subject, name: String, sets: &[PosedSet<Frame>]| {
        let finding = subject.window(sets, STRIDE_SEC).and_then(|w| subject.step(&w, &cameras)).map_or_else(
            |e| refused(&e),
            |(scene, views)| Finding {
                worst_error: apart(&scene, &base),
                nonfinite: nonfinite(&scene, &views),
                refused: None,
            },
        );
        sheet.add(name, finding);
    };
    for metres in [1e3, 1e5, 1e7] {
        let shift = Rigid::new(DQuat::IDENTITY, DVec3::new(metres, -metres, 1e-4 * metres));
        moved(subject, format!("origin {metres:e} m away"), &placed(&sets, &shift));
    }
    for degrees in [-180.0, -135.0, -90.0, 45.0, 90.0, 179.999, 180.0] {
        let turn = Rigid::new(DQuat::from_rotation_z(f64::to_radians(degrees)), DVec3::ZERO);
        moved(subject, format!("heading turned by {degrees} degrees"), &placed(&sets, &turn));
    }
    let last = sets.iter().flat_map(|s| s.frames.iter().map(|f| f.stamp_ns)).max().unwrap_or(0);
    for (name, first_ns) in
        [("0 ns", 0), ("1.8e18 ns (the year 2027)", 1_800_000_000_000_000_000), ("2^62 ns", 1 << 62)]
    {
        moved(subject, format!("stamps from {name}"), &restamped(&sets, |ns| ns + first_ns));
    }
    moved(subject, "stamps up to the largest i64".into(), &restamped(&sets, |ns| i64::MAX - last + ns));

    let mut sheet = Sheet { group: "window", against: "f64 network, relative", limit: F32, found };
    for seconds in [1e-3, 1e-2, 0.1, 1.0, 5.0] {
        let timed = restamped(&sets, |ns| (ns as f64 * seconds / STRIDE_SEC).round() as i64);
        let finding = subject.window(&timed, seconds).map_or_else(|e| refused(&e), |w| subject.compare(&w, &cameras));
        sheet.add(format!("stride {seconds} s"), finding);
    }
    for metres in [0.0, 1e-3, 1.0, 30.0, 1e3] {
        let mut spread = sets.clone();
        let start = spread[0].clone();
        for (k, set) in spread.iter_mut().enumerate() {
            for (frame, first) in set.frames.iter_mut().zip(&start.frames) {
                let along = first.map_from_camera.apply(DVec3::Z) - first.map_from_camera.apply(DVec3::ZERO);
                let shift = Rigid::new(DQuat::IDENTITY, along * (metres * k as f64));
                frame.map_from_camera = shift.compose(&first.map_from_camera);
            }
        }
        let finding =
            subject.window(&spread, STRIDE_SEC).map_or_else(|e| refused(&e), |w| subject.compare(&w, &cameras));
        sheet.add(format!("timesteps {metres} m apart"), finding);
    }
    for degrees in [5.0, 30.0, 120.0, 170.0] {
        let lens = |k: &Intrinsics| Intrinsics::from_fov(degrees, k.width, k.height);
        let lenses: Vec<Intrinsics> = cameras.iter().map(lens).collect();
        sheet.add(format!("field of view {degrees} degrees"), subject.compare(&window, &lenses));
    }
    let mut wheel = Finding::default();
    for degrees in [-180.0, 45.0] {
        // A vehicle that spins on the spot: the heading passes +-180 degrees inside the window.
        let mut spun = sets.clone();
        for (t, set) in spun.iter_mut().enumerate() {
            let turn = Rigid::new(DQuat::from_rotation_z(f64::to_radians(degrees + 60.0 * t as f64)), DVec3::ZERO);
            set.frames.iter_mut().for_each(|f| f.map_from_camera = turn.compose(&f.map_from_camera));
        }
        wheel.join(subject.window(&spun, STRIDE_SEC).map_or_else(|e| refused(&e), |w| subject.compare(&w, &cameras)));
    }
    sheet.add("120 degrees a second through +-180", wheel);
    Ok(())
}

fn placed(sets: &[PosedSet<Frame>], to: &Rigid) -> Vec<PosedSet<Frame>> {
    let mut sets = sets.to_vec();
    for frame in sets.iter_mut().flat_map(|s| &mut s.frames) {
        frame.map_from_camera = to.compose(&frame.map_from_camera);
    }
    sets
}

fn restamped(sets: &[PosedSet<Frame>], to: impl Fn(i64) -> i64) -> Vec<PosedSet<Frame>> {
    let mut sets = sets.to_vec();
    for set in &mut sets {
        set.stamp_ns = to(set.stamp_ns);
        set.frames.iter_mut().for_each(|f| f.stamp_ns = to(f.stamp_ns));
    }
    sets
}
