use super::*;

const MS: i64 = 1_000_000;
const SEC: i64 = 1000 * MS;

fn stream(n: i64, stamp_ns: impl Fn(i64) -> i64, lag_ns: i64) -> Stamps {
    let mut s = Stamps::default();
    (0..n).for_each(|i| s.add(stamp_ns(i), stamp_ns(i) + lag_ns));
    s
}

fn plan() -> TopicPlan {
    let camera =
        super::super::topics::CameraTopics { image: 0, name: "/camera/image".into(), compressed: false, info: 1 };
    TopicPlan {
        cameras: vec![camera],
        pose: PoseTopic::Message(2),
        tf: vec![],
        tf_static: vec![],
        truth: vec![],
        left_out: vec![],
    }
}

fn survey(images: Stamps, poses: Stamps) -> Survey {
    Survey { cameras: vec![images], poses: BTreeMap::from([("/odometry".to_owned(), poses)]), whole: true }
}

fn refused(s: &Survey, config: &InputConfig) -> String {
    s.check(&plan(), config, 3.0).map_or_else(|e| e.to_string(), |()| String::new())
}

#[test]
fn two_clocks_and_empty_stamps_are_refused_with_the_key() {
    let good = |n: i64| stream(n, |i| 1_700_000_000 * SEC + i * 100 * MS, 0);
    let config = InputConfig::default();
    assert_eq!(refused(&survey(good(20), good(20)), &config), "");
    let boot = stream(20, |i| 1000 * SEC + i * 100 * MS, 0);
    let e = refused(&survey(good(20), boot), &config);
    assert!(e.contains("1,699,999,000 s later than poses: two clocks") && e.contains("input.stamps=recorded"), "{e}");
    assert!(e.contains("input.image_time_offset_sec=[-1699999000]"), "{e}");
    let e = refused(&survey(stream(20, |_| 0, 0), good(20)), &config);
    assert!(e.contains("/camera/image: all 20 stamps are 0 s") && e.contains("input.stamps=recorded"), "{e}");
    let recorded = InputConfig { stamps: "recorded".into(), ..InputConfig::default() };
    assert_eq!(refused(&survey(stream(20, |_| 0, 0), good(20)), &recorded), "");
}

#[test]
fn an_offset_of_the_images_is_reckoned_with() {
    let images = stream(20, |i| 110 * SEC + i * 100 * MS, 0);
    let poses = || stream(20, |i| 100 * SEC + i * 100 * MS, 0);
    let e = refused(&survey(images.clone(), poses()), &InputConfig::default());
    assert!(e.contains("no image lies between two poses") && e.contains("110.000 to 111.900"), "{e}");
    let config = InputConfig { image_time_offset_sec: vec![-10.0], ..InputConfig::default() };
    assert_eq!(refused(&survey(images.clone(), poses()), &config), "");
    // Of a beginning nobody can say that the poses will not come.
    let beginning = Survey { whole: false, ..survey(images, poses()) };
    assert_eq!(refused(&beginning, &InputConfig::default()), "");
}

#[test]
fn transforms_dated_ahead_are_told_from_late_ones_and_other_clocks() {
    let images = |lag_ns| stream(20, |i| i * 100 * MS, lag_ns);
    let ahead = stream(20, |i| i * 100 * MS + SEC, -SEC);
    let found = survey(images(20 * MS), ahead.clone()).dated_ahead();
    assert_eq!(found.values().copied().collect::<Vec<_>>(), [SEC]);
    assert!(survey(images(0), stream(20, |i| i * 100 * MS, 2 * SEC)).dated_ahead().is_empty());
    // Stamps of simulated time: the time of recording says nothing of them.
    assert!(survey(images(1_000_000 * SEC), ahead).dated_ahead().is_empty());
}

#[test]
fn rates_and_gaps_are_measured() {
    let s = stream(20, |i| (i + i / 10) * 100 * MS, 0);
    assert_eq!((s.interval_sec(), s.gap_sec), (Some(0.1), 0.2));
    assert_eq!(Stamps::default().interval_sec(), None);
}
