use proptest::prelude::*;

use super::*;

const SEC: i64 = 1_000_000_000;
const MS: i64 = 1_000_000;

fn config() -> SyncConfig {
    SyncConfig::default()
}

fn sync(cameras: usize) -> Synchronizer<u64> {
    Synchronizer::new(cameras, &config(), &[])
}

fn drain(s: &mut Synchronizer<u64>) -> Vec<FrameSet<u64>> {
    std::iter::from_fn(|| s.pop()).collect()
}

#[test]
fn offsets_shift_the_stamps() {
    let mut s = Synchronizer::new(2, &config(), &[0.0, -0.1]);
    s.push(0, SEC, 0);
    s.push(1, SEC + 100 * MS, 1);
    assert_eq!(s.pop(), Some(FrameSet { stamp_ns: SEC, epoch: 0, frames: vec![(SEC, 0), (SEC, 1)] }));
}

#[test]
fn the_middle_image_is_the_reference() {
    let mut s = sync(3);
    for (camera, ms) in [(0, 0), (1, 15), (2, 30)] {
        s.push(camera, SEC + ms * MS, camera as u64);
    }
    // The outer two are 30 ms apart, more than the slop, but each is within it of the middle one.
    assert_eq!(s.pop().unwrap().stamp_ns, SEC + 15 * MS);
}

#[test]
fn the_nearest_of_several_images_is_taken() {
    let mut s = sync(2);
    for ms in [0, 33, 66, 100] {
        s.push(0, SEC + ms * MS, ms as u64);
    }
    s.push(1, SEC + 98 * MS, 1);
    let set = s.pop().unwrap();
    assert_eq!(set.frames[0], (SEC + 100 * MS, 100));
    // Older than the first set, so that nobody can say whether a partner is missing.
    assert_eq!((s.pending(), s.drops().get(DropReason::Edge)), (0, 3));
}

#[test]
fn a_camera_at_twice_the_rate_gives_every_set_and_counts_the_rest() {
    let mut s = sync(2);
    for i in 0..100 {
        s.push(0, SEC + i * 50 * MS, 0);
        if i % 2 == 0 {
            s.push(1, SEC + i * 50 * MS + 3 * MS, 1);
        }
        s.advance(SEC + i * 50 * MS);
    }
    s.flush();
    assert_eq!((drain(&mut s).len(), s.drops().get(DropReason::Surplus), s.drops().total()), (50, 50, 50));
    assert_eq!(s.drops().lost(), 0);
}

#[test]
fn an_image_missing_from_the_slower_camera_is_a_loss_and_the_faster_cameras_others_are_not() {
    let mut s = sync(2);
    for i in 0..100 {
        s.push(0, SEC + i * 50 * MS, 0);
        // Every tenth image of the slower camera is missing.
        if i % 2 == 0 && i % 20 != 10 {
            s.push(1, SEC + i * 50 * MS + 3 * MS, 1);
        }
        s.advance(SEC + i * 50 * MS);
    }
    s.flush();
    let d = s.drops();
    assert_eq!((d.get(DropReason::Incomplete), d.get(DropReason::Surplus), d.total()), (5, 50, 55));
}

#[test]
fn cameras_that_begin_and_end_apart_lose_nothing() {
    let mut s = sync(2);
    for i in 0..30 {
        if i < 28 {
            s.push(0, SEC + i * 100 * MS, 0);
        }
        if i >= 2 {
            s.push(1, SEC + i * 100 * MS, 1);
        }
        s.advance(SEC + i * 100 * MS);
    }
    s.flush();
    assert_eq!((drain(&mut s).len(), s.drops().get(DropReason::Edge), s.drops().lost()), (26, 4, 0));
}

#[test]
fn a_camera_that_stops_is_reported_and_memory_stays_bounded() {
    let mut s = sync(2);
    let mut reports = Vec::new();
    for i in 0..1200 {
        let stamp_ns = i * 100 * MS;
        s.push(0, stamp_ns, 0);
        if i < 10 {
            s.push(1, stamp_ns, 1);
        }
        s.advance(stamp_ns);
        drain(&mut s);
        assert!(s.pending() <= 4, "{}", s.pending());
        reports.extend(s.starvation(stamp_ns));
    }
    assert_eq!(reports.len(), 23, "one each 5 s of the 119 s without");
    let text = reports[0].describe(&["/left".into(), "/right".into()]);
    assert!(text.contains("/left 50 images") && text.contains("/right 0 images") && text.contains("QoS"), "{text}");
    assert_eq!(reports[0].nearest_gap_sec, None);
}

#[test]
fn a_constant_shift_between_cameras_is_reported_as_the_nearest_gap() {
    let mut s = sync(2);
    let mut report = None;
    for i in 0..60 {
        s.push(0, SEC + i * 100 * MS, 0);
        s.push(1, SEC + i * 100 * MS + 40 * MS, 1);
        s.advance(SEC + i * 100 * MS);
        report = report.or_else(|| s.starvation(i * 100 * MS));
    }
    let report = report.unwrap();
    assert!((report.nearest_gap_sec.unwrap() - 0.04).abs() < 1e-9);
    assert!(
        report.describe(&[]).contains("nearest stamp gap 0.040 s against sync.slop_sec 0.020"),
        "{}",
        report.describe(&[])
    );
}

#[test]
fn without_advance_a_missing_camera_overflows_instead_of_growing() {
    let mut s = sync(2);
    for i in 0..1000 {
        s.push(0, i * 100 * MS, 0);
    }
    assert_eq!(s.pending(), config().max_pending);
    assert_eq!(s.drops().get(DropReason::Overflow) as usize, 1000 - config().max_pending);
}

#[test]
fn a_looped_recording_moves_the_epoch_on_and_gives_every_set_again() {
    for cameras in [1, 3] {
        let mut s = sync(cameras);
        for _ in 0..3 {
            for i in 0..50 {
                for camera in 0..cameras {
                    s.push(camera, 100 * SEC + i * 100 * MS, 0);
                }
                s.advance(100 * SEC + i * 100 * MS);
            }
        }
        let sets = drain(&mut s);
        assert_eq!(sets.len(), 150);
        assert!((0..150).all(|i| sets[i].epoch as usize == i / 50));
        assert_eq!(s.drops().total(), 0);
    }
}

#[test]
fn images_that_all_come_long_after_other_inputs_are_not_lost() {
    let mut s = sync(2);
    for i in 0..50 {
        // Poses are two seconds ahead of the images, many times the timeout.
        s.advance(SEC * 2 + i * 100 * MS);
        s.push(0, i * 100 * MS, 0);
        s.advance(SEC * 2 + i * 100 * MS + 50 * MS);
        s.push(1, i * 100 * MS, 1);
    }
    assert_eq!((drain(&mut s).len(), s.drops().total()), (50, 0));
}

#[test]
fn stray_stamps_cost_their_own_image_only() {
    let mut s = sync(2);
    for i in 0..50 {
        s.push(0, 100 * SEC + i * 100 * MS, 0);
        if i % 10 == 5 {
            s.push(1, if i % 20 == 5 { 0 } else { 1 << 62 }, 1);
            s.advance(1 << 62);
        } else {
            s.push(1, 100 * SEC + i * 100 * MS, 1);
        }
    }
    s.flush();
    assert_eq!((drain(&mut s).len(), s.epoch()), (45, 0));
    assert_eq!((s.drops().get(DropReason::ClockJump), s.drops().get(DropReason::Incomplete)), (5, 5));
}

#[test]
fn late_duplicate_and_unknown_cameras_are_told_apart() {
    let mut s = sync(2);
    for camera in [0, 0, 1] {
        s.push(camera, 5 * SEC, 0);
    }
    s.push(1, 5 * SEC, 0);
    s.push(1, 5 * SEC - 500 * MS, 0);
    s.push(7, 5 * SEC, 0);
    let d = s.drops();
    assert_eq!((d.get(DropReason::Duplicate), d.get(DropReason::Late), d.get(DropReason::NoCalibration)), (2, 1, 1));
}

fn wild_stamp() -> impl Strategy<Value = i64> {
    prop_oneof![Just(0i64), Just(1i64 << 62), Just(i64::MIN), 0i64..(1 << 62)]
}

proptest! {
    #[test]
    fn perfectly_synchronized_images_are_never_dropped_nor_delayed(
        cameras in 1usize..7, start_ns in 0i64..(1 << 62), order in proptest::collection::vec(0usize..720, 1..40),
    ) {
        let mut s = sync(cameras);
        for (step, mut code) in order.into_iter().enumerate() {
            let stamp_ns = start_ns + step as i64 * 100 * MS;
            let mut left: Vec<usize> = (0..cameras).collect();
            while !left.is_empty() {
                prop_assert!(s.pop().is_none());
                let camera = left.remove(code % left.len());
                code /= left.len() + 1;
                s.push(camera, stamp_ns, camera as u64);
                s.advance(stamp_ns);
            }
            let set = s.pop();
            prop_assert_eq!(set.as_ref().map(|f| f.stamp_ns), Some(stamp_ns));
            let in_order = |f: FrameSet<u64>| f.frames.iter().enumerate().all(|(i, &(t, x))| t == stamp_ns && x == i as u64);
            prop_assert!(set.is_some_and(in_order));
        }
        prop_assert_eq!((s.drops().total(), s.pending()), (0, 0));
    }

    #[test]
    fn jitter_within_half_the_slop_loses_no_set(
        jitter_ms in proptest::collection::vec((-10i64..=10, -10i64..=10, -10i64..=10), 1..60),
    ) {
        let mut s = sync(3);
        for (i, (a, b, c)) in jitter_ms.iter().enumerate() {
            for (camera, ms) in [a, b, c].into_iter().enumerate() {
                s.push(camera, SEC + (i as i64 * 100 + ms) * MS, 0);
            }
            s.advance(SEC + i as i64 * 100 * MS);
        }
        prop_assert_eq!((drain(&mut s).len(), s.drops().total()), (jitter_ms.len(), 0));
    }

    /// Any traffic at all: jitter, disorder, duplicates, stray stamps, jumps, timeouts, resets.
    #[test]
    fn every_image_is_accounted_for(
        cameras in 1usize..5,
        events in proptest::collection::vec((0u8..40, 0usize..5, -60i64..60, wild_stamp()), 1..400),
    ) {
        let mut s = sync(cameras);
        let (mut base_ns, mut emitted, mut sets, mut pushed) = (1000 * SEC, 0u64, Vec::new(), 0u64);
        for (kind, camera, jitter_ms, wild_ns) in events {
            match kind {
                0 => s.push(camera, wild_ns, pushed),
                1 => base_ns = wild_ns.clamp(0, 1 << 62),
                2 => s.reset(),
                3..=8 => s.advance(base_ns + jitter_ms * 10 * MS),
                9..=14 => base_ns += 50 * MS,
                15 => s.flush(),
                _ => s.push(camera, base_ns + jitter_ms * MS, pushed),
            }
            pushed += u64::from(matches!(kind, 0 | 16..));
            while let Some(set) = s.pop() {
                emitted += set.frames.len() as u64;
                sets.push(set);
            }
            prop_assert_eq!(s.images_in(), pushed);
            prop_assert_eq!(pushed, emitted + s.drops().total() + s.pending() as u64);
        }
        s.flush();
        prop_assert_eq!((s.pending(), pushed), (0, emitted + s.drops().total()));
        for set in &sets {
            prop_assert_eq!(set.frames.len(), cameras);
            prop_assert!(set.frames.iter().all(|(t, _)| t.abs_diff(set.stamp_ns) <= s.slop_ns));
            prop_assert!(set.frames.iter().any(|(t, _)| *t == set.stamp_ns));
        }
        for pair in sets.windows(2) {
            prop_assert!((pair[0].epoch, pair[0].stamp_ns) < (pair[1].epoch, pair[1].stamp_ns));
        }
    }
}
