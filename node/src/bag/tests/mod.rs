//! Whole bags: sqlite3 in its schemas, folders, splits, compression, the recorded odd ones, and those that mean harm (`hostile`).

mod hostile;

use std::path::{Path, PathBuf};

use rusqlite::Connection;

use super::{Bag, BagError, RawMessage};

/// Message `i` of a sample bag.
fn payload(i: i64) -> Vec<u8> {
    [&[0u8, 1, 0, 0][..], &i.to_le_bytes(), &vec![i as u8; 3000]].concat()
}

/// Which columns and tables a database has.
#[derive(Clone, Copy, PartialEq)]
enum Schema {
    /// First rosbag2: no serialization_format.
    Oldest,
    /// Foxy to Galactic: no schema table.
    Old,
    /// Iron and later.
    New,
}

/// A database with messages `from..to`, written in descending time order, on `/a` and (odd ones) `/b`.
fn database(path: &Path, schema: Schema, from: i64, to: i64, pack: bool) {
    let db = Connection::open(path).unwrap();
    db.execute_batch("PRAGMA synchronous = OFF; BEGIN").unwrap();
    let extra = match schema {
        Schema::Oldest => "",
        Schema::Old => ", serialization_format TEXT NOT NULL",
        Schema::New => ", serialization_format TEXT NOT NULL, offered_qos_profiles TEXT, type_description_hash TEXT",
    };
    db.execute_batch(&format!(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL{extra});
         CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB NOT NULL);
         CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
    ))
    .unwrap();
    if schema == Schema::New {
        db.execute_batch(
            "CREATE TABLE schema(schema_version INTEGER, ros_distro TEXT); INSERT INTO schema VALUES (4, 'x')",
        )
        .unwrap();
    }
    let cdr = if schema == Schema::Oldest { "" } else { ", 'cdr'" };
    let rest = if schema == Schema::New { ", '', ''" } else { "" };
    for (id, name) in [(4, "/a"), (9, "/b")] {
        db.execute(&format!("INSERT INTO topics VALUES ({id}, '{name}', 'std_msgs/String'{cdr}{rest})"), ()).unwrap();
    }
    for i in (from..to).rev() {
        let data = if pack { zstd::bulk::compress(&payload(i), 1).unwrap() } else { payload(i) };
        let topic = if i % 2 == 0 { 4 } else { 9 };
        db.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", (topic, i * 10, data)).unwrap();
    }
    db.execute_batch("COMMIT").unwrap();
}

fn read(path: &Path) -> (Bag, Vec<RawMessage>) {
    let bag = Bag::open(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let all: Vec<usize> = (0..bag.topics().len()).collect();
    let messages = bag.messages(&all).unwrap().collect::<Result<Vec<_>, _>>().unwrap();
    (bag, messages)
}

fn assert_is(messages: &[RawMessage], range: std::ops::Range<i64>) {
    let got: Vec<(i64, &[u8])> = messages.iter().map(|m| (m.log_time_ns, m.data.as_slice())).collect();
    let want: Vec<Vec<u8>> = range.clone().map(payload).collect();
    assert_eq!(got, range.zip(&want).map(|(i, d)| (i * 10, d.as_slice())).collect::<Vec<_>>());
}

fn listing(folder: &Path) -> Vec<PathBuf> {
    let mut v: Vec<PathBuf> = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    v.sort();
    v
}

#[test]
fn sqlite_in_every_schema_ordered_and_untouched() {
    for schema in [Schema::Oldest, Schema::Old, Schema::New] {
        let dir = tempfile::tempdir().unwrap();
        // A name that needs escaping in a URI.
        let path = dir.path().join("odd %41?#name.db3");
        database(&path, schema, 0, 50, false);
        let before = (listing(dir.path()), std::fs::read(&path).unwrap());
        let (bag, messages) = read(&path);
        assert_is(&messages, 0..50);
        assert_eq!(bag.topics()[0].type_name, "std_msgs/msg/String");
        assert_eq!(
            (bag.topics()[0].count, bag.topics()[1].count, bag.start_ns(), bag.end_ns()),
            (25, 25, Some(0), Some(490))
        );
        let only_b: Vec<_> = bag.messages(&[1]).unwrap().map(|m| m.unwrap().log_time_ns / 10 % 2).collect();
        assert_eq!(only_b, vec![1; 25]);
        assert_eq!((listing(dir.path()), std::fs::read(&path).unwrap()), before);
        assert!(bag.problems().is_empty());
    }
}

#[test]
fn splits_merge_across_files_and_a_missing_one_is_named() {
    let dir = tempfile::tempdir().unwrap();
    // Overlapping in time: evens of the second file fall between those of the first.
    database(&dir.path().join("b_2.db3"), Schema::Old, 20, 40, false);
    database(&dir.path().join("b_10.db3"), Schema::New, 40, 60, false);
    database(&dir.path().join("b_1.db3"), Schema::Oldest, 0, 20, false);
    assert_is(&read(dir.path()).1, 0..60);

    let yaml = "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: sqlite3\n  message_count: 80\n  relative_file_paths: [old/b_1.db3, b_2.db3, b_3.db3, ../../etc/b_10.db3]\n";
    std::fs::write(dir.path().join("metadata.yaml"), yaml).unwrap();
    let (bag, messages) = read(dir.path());
    assert_is(&messages, 0..60);
    let problems = bag.problems().join("\n");
    assert!(
        problems.contains("`b_3.db3`") && problems.contains("promises 80 messages, the files hold 60"),
        "{problems}"
    );

    // A split that is no bag costs only itself.
    std::fs::write(dir.path().join("b_2.db3"), b"").unwrap();
    let (bag, messages) = read(dir.path());
    assert_eq!(messages.len(), 40);
    assert!(bag.problems().iter().any(|p| p.contains("b_2.db3: the file is empty")));
}

#[test]
fn reading_can_move_to_a_thread() {
    fn can_move<T: Send + 'static>(_: &T) {}
    let dir = tempfile::tempdir().unwrap();
    database(&dir.path().join("b.db3"), Schema::New, 0, 4, false);
    let bag = Bag::open(dir.path()).unwrap();
    let messages = bag.messages(&[0]).unwrap();
    can_move(&messages);
    drop(bag);
    assert_eq!(std::thread::spawn(move || messages.count()).join().unwrap(), 2);
}

#[test]
fn ties_between_files_come_in_file_order() {
    let dir = tempfile::tempdir().unwrap();
    for name in ["b_0.db3", "b_1.db3"] {
        database(&dir.path().join(name), Schema::New, 0, 10, false);
    }
    let (_, messages) = read(dir.path());
    assert_eq!(messages.len(), 20);
    assert!(messages.is_sorted_by_key(|m| m.log_time_ns));
}

#[test]
fn zstd_files_and_zstd_messages() {
    let dir = tempfile::tempdir().unwrap();
    let packed = dir.path().join("b_0.db3");
    database(&packed, Schema::New, 0, 30, true);
    assert_is(&read(&packed).1, 0..30);

    let plain = std::fs::read(&packed).unwrap();
    let zstd_file = dir.path().join("b_0.db3.zstd");
    std::fs::write(&zstd_file, zstd::bulk::compress(&plain, 1).unwrap()).unwrap();
    assert_is(&read(&zstd_file).1, 0..30);
    // Both there, as `ros2 bag play` leaves them: read once.
    let (bag, messages) = read(dir.path());
    assert_is(&messages, 0..30);
    assert!(bag.problems()[0].contains("b_0.db3.zstd is there unpacked as well"));

    std::fs::remove_file(&packed).unwrap();
    let yaml = "rosbag2_bagfile_information: {compression_format: zstd, compression_mode: FILE, relative_file_paths: [b_0.db3.zstd]}";
    std::fs::write(dir.path().join("metadata.yaml"), yaml).unwrap();
    assert_is(&read(dir.path()).1, 0..30);

    std::fs::write(&zstd_file, zstd::bulk::compress(b"hello", 1).unwrap()).unwrap();
    let e = Bag::open(&zstd_file).unwrap_err().to_string();
    assert!(e.contains("inside the zstd file"), "{e}");
    // A bomb: 512 MiB of zeros in a few kB, over 200 times its size plus the allowance.
    let mut encoder = zstd::stream::write::Encoder::new(Vec::new(), 1).unwrap();
    for _ in 0..512 {
        std::io::Write::write_all(&mut encoder, &vec![0u8; 1 << 20]).unwrap();
    }
    std::fs::write(&zstd_file, encoder.finish().unwrap()).unwrap();
    assert!(matches!(Bag::open(&zstd_file), Err(BagError::TooLarge { .. })));
}

#[test]
fn a_write_ahead_log_is_merged_in_a_copy() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("live.db3");
    database(&source, Schema::New, 0, 10, false);
    let db = Connection::open(&source).unwrap();
    db.query_row("PRAGMA journal_mode=WAL", (), |_| Ok(())).unwrap();
    db.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (4, 100, ?)", [payload(10)]).unwrap();
    // As after a kill: the log exists and was never merged.
    let bag_dir = tempfile::tempdir().unwrap();
    let path = bag_dir.path().join("x.db3");
    std::fs::copy(&source, &path).unwrap();
    std::fs::copy(dir.path().join("live.db3-wal"), bag_dir.path().join("x.db3-wal")).unwrap();
    let before = listing(bag_dir.path());
    let (bag, messages) = read(&path);
    assert_is(&messages, 0..11);
    assert!(bag.problems().is_empty());
    assert_eq!(listing(bag_dir.path()), before);
}

#[test]
fn odd_databases_say_what_they_are() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("x.db3");
    let db = Connection::open(&path).unwrap();
    db.execute_batch("CREATE TABLE cooking(recipe TEXT)").unwrap();
    let e = Bag::open(&path).unwrap_err().to_string();
    assert!(e.contains("without a table `topics`"), "{e}");
    db.execute_batch("CREATE TABLE topics(id, name)").unwrap();
    let e = Bag::open(&path).unwrap_err().to_string();
    assert!(e.contains("`topics` has no column `type`"), "{e}");
    drop(db);

    std::fs::remove_file(&path).unwrap();
    database(&path, Schema::New, 0, 10, false);
    let db = Connection::open(&path).unwrap();
    db.execute_batch(
        "INSERT INTO messages(topic_id, timestamp, data) VALUES (77, 5, x'00');
         INSERT INTO messages(topic_id, timestamp, data) VALUES (4, 'noon', x'00');
         INSERT INTO messages(topic_id, timestamp, data) VALUES (4, 55, 3.5);",
    )
    .unwrap();
    drop(db);
    let bag = Bag::open(&path).unwrap();
    let (good, bad): (Vec<_>, Vec<_>) = bag.messages(&[0, 1]).unwrap().partition(Result::is_ok);
    assert_eq!((good.len(), bad.len()), (10, 1));
    let e = bad.into_iter().next().unwrap().unwrap_err().to_string();
    assert!(e.contains("topic /a, logged at 55 ns") && e.contains("instead of bytes"), "{e}");
    let problems = bag.problems().join("\n");
    assert!(
        problems.contains("1 messages belong to no topic") && problems.contains("1 messages have no integer"),
        "{problems}"
    );
    assert!(problems.contains("topic /a: 5 of 6 messages could be read"), "{problems}");
}

#[test]
fn read_only_folders_and_missing_paths() {
    let dir = tempfile::tempdir().unwrap();
    assert!(matches!(Bag::open(dir.path()), Err(BagError::NoBagInFolder { .. })));
    assert!(matches!(Bag::open(&dir.path().join("none")), Err(BagError::Io { .. })));
    database(&dir.path().join("x.db3"), Schema::New, 0, 5, false);
    let mut rights = std::fs::metadata(dir.path()).unwrap().permissions();
    let restore = rights.clone();
    rights.set_readonly(true);
    std::fs::set_permissions(dir.path(), rights).unwrap();
    let count = read(dir.path()).1.len();
    std::fs::set_permissions(dir.path(), restore).unwrap();
    assert_eq!(count, 5);
}

/// The shared recorded bags, where the machine has them.
fn shared() -> Option<PathBuf> {
    let named = std::env::var_os("STORM_SHARED").map(PathBuf::from);
    let folder = named.unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared"));
    folder.join("bags").is_dir().then(|| folder.join("bags"))
}

#[test]
fn recorded_bags_read_as_other_readers_read_them() {
    let Some(bags) = shared() else {
        println!("SKIPPED: no shared/bags beside the project and STORM_SHARED is not set");
        return;
    };
    // Message counts by Python's `mcap` and `sqlite3`.
    let py = "odd/rosbag2/rosbag2_py/test/resources";
    let tests = "odd/rosbag2/rosbag2_tests/resources";
    let seek = "odd/rosbag2/rosbag2_transport/test/resources";
    let mut counts = vec![
        ("kitti_ramp_stereo".to_owned(), 256),
        ("kitti_ramp_stereo_sqlite".to_owned(), 101),
        ("nav2_turtlebot.mcap".to_owned(), 8197),
        ("odd/rosbag2_test".to_owned(), 4695),
        ("odd/rosbag2/ros2bag/test/resources/empty_bag".to_owned(), 0),
        ("odd/rosbag2/rosbag2_cpp/test/rosbag2_cpp/bags/topics_and_services.mcap".to_owned(), 13),
        ("odd/rosbag2/rosbag2_cpp/test/rosbag2_cpp/bags/topics_and_services.db3".to_owned(), 13),
    ];
    for storage in ["mcap", "sqlite3"] {
        for (folder, n) in [
            ("convert_a", 150),
            ("convert_b", 75),
            ("reindex_test_bags/multiple_files", 3177),
            ("talker", 20),
            ("wbag", 6074),
        ] {
            counts.push((format!("{py}/{storage}/{folder}"), n));
        }
        counts.push((format!("{tests}/{storage}/bag_with_topics_and_service_events"), 10));
        counts.push((format!("{tests}/{storage}/cdr_test"), 7));
        counts.push((format!("{seek}/{storage}/test_bag_for_seek"), 5));
    }
    for (name, count) in counts {
        let (bag, messages) = read(&bags.join(&name));
        assert_eq!((messages.len(), bag.message_count()), (count, count as u64), "{name}");
        assert!(messages.is_sorted_by_key(|m| m.log_time_ns), "{name}");
        let problems = bag.problems();
        assert!(problems.is_empty() || count == 0, "{name}: {problems:?}");
    }
    for (name, found) in [
        ("odd/ros1_profile.mcap", "profile `ros1`"),
        ("odd/foxglove_json.mcap", "`json`"),
        (&format!("{tests}/mcap/wrong_rmw_test"), "`wrong_format`"),
        (&format!("{tests}/sqlite3/wrong_rmw_test"), "`wrong_format`"),
        ("odd", "no bag in this folder"),
        ("README.md", "not a ROS 2 bag"),
    ] {
        let path = if name == "odd" { bags.join("odd/rosbag2/rosbag2_py") } else { bags.join(name) };
        let e = Bag::open(&path).unwrap_err().to_string();
        assert!(e.contains(found), "{name}: {e}");
    }
    let (bag, messages) = read(&bags.join("odd/chunk_not_closed.mcap"));
    assert!(messages.is_empty() && bag.problems().iter().any(|p| p.contains("never closed")), "{:?}", bag.problems());
}
