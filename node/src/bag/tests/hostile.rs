//! Bags that are cut, damaged, or made to take a reader's time or memory.

use proptest::prelude::*;

use super::*;

#[test]
fn cut_databases_never_panic() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("x.db3");
    database(&path, Schema::New, 0, 60, false);
    let whole = std::fs::read(&path).unwrap();
    let mut best = 0;
    for cut in (1..whole.len()).step_by(1511) {
        let path = dir.path().join(format!("{cut}.db3"));
        std::fs::write(&path, &whole[..cut]).unwrap();
        if let Ok(bag) = Bag::open(&path) {
            let all: Vec<usize> = (0..bag.topics().len()).collect();
            let read = bag.messages(&all).unwrap().filter(Result::is_ok).count();
            assert!(read == 60 || !bag.problems().is_empty(), "cut at {cut} went unnoticed");
            best = best.max(read);
        }
    }
    assert!(best > 0, "nothing could be read from any cut");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    #[test]
    fn damaged_databases_never_panic(flips in proptest::collection::vec((0.0f64..1.0, any::<u8>()), 1..40)) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("x.db3");
        database(&path, Schema::New, 0, 12, false);
        let mut bytes = std::fs::read(&path).unwrap();
        for (at, value) in flips {
            let i = (at * bytes.len() as f64) as usize;
            bytes[i] = value;
        }
        let path = dir.path().join("damaged.db3");
        std::fs::write(&path, &bytes).unwrap();
        if let Ok(bag) = Bag::open(&path) {
            let readable: Vec<usize> = (0..bag.topics().len()).filter(|i| bag.topics()[*i].is_readable()).collect();
            let _ = bag.messages(&readable).unwrap().count();
        }
    }
}

/// A database is a program too: rows without end, and values worked out when asked for.
#[test]
fn databases_that_compute_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let tables = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);";
    let endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT";
    for (name, sql, says) in [
        (
            "topics",
            format!(
                "CREATE VIEW topics AS {endless} i AS id, '/a' AS name, 'x/Y' AS type, 'cdr' AS serialization_format FROM n; CREATE TABLE messages(topic_id, timestamp, data);"
            ),
            "view",
        ),
        (
            "messages",
            format!("{tables} CREATE VIEW messages AS {endless} 1 AS topic_id, i AS timestamp, x'00' AS data FROM n;"),
            "view",
        ),
        (
            "virtual",
            format!("{tables} CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data);"),
            "virtual table",
        ),
        (
            "generated",
            format!("{tables} CREATE TABLE messages(topic_id, timestamp, data AS (zeroblob(1000000000)));"),
            "no column `data`",
        ),
    ] {
        let path = dir.path().join(format!("{name}.db3"));
        let db = Connection::open(&path).unwrap();
        db.execute_batch(&sql).unwrap();
        db.close().unwrap();
        let e = Bag::open(&path).unwrap_err().to_string();
        assert!(e.contains(says), "{name}: {e}");
    }
}

#[test]
fn a_bag_of_very_many_topics_is_read_in_proportion() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("many.db3");
    let db = Connection::open(&path).unwrap();
    let n = 200_000;
    db.execute_batch(&format!(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
         CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);
         WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < {n})
         INSERT INTO topics SELECT i, '/t' || i, 'a/msg/B', 'other' || i FROM n;
         INSERT INTO topics VALUES (0, '/a', 'a/msg/B', 'cdr');
         INSERT INTO messages VALUES (1, 0, 5, x'00010000');"
    ))
    .unwrap();
    db.close().unwrap();
    let start = std::time::Instant::now();
    let bag = Bag::open(&path).unwrap();
    assert_eq!((bag.topics().len(), bag.messages(&[bag.topic("/a").unwrap()]).unwrap().count()), (n + 1, 1));
    // Comparing every topic with every other took minutes.
    assert!(start.elapsed().as_secs() < 20, "{:?}", start.elapsed());
}

/// Yaml whose aliases name each other ten at a time: 10^9 entries from 400 bytes.
#[test]
fn metadata_that_explodes_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("metadata.yaml"), alias_bomb("rosbag2_bagfile_information")).unwrap();
    let e = Bag::open(dir.path()).unwrap_err().to_string();
    assert!(e.contains("metadata"), "{e}");
    std::fs::write(dir.path().join("metadata.yaml"), "[".repeat(1 << 20)).unwrap();
    let e = Bag::open(dir.path()).unwrap_err().to_string();
    assert!(e.contains("nest"), "{e}");
}

/// Aliases of aliases under `key`.
fn alias_bomb(key: &str) -> String {
    let mut text = String::from("a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n");
    for i in 1..9 {
        let names = vec![format!("*a{}", i - 1); 10].join(", ");
        text.push_str(&format!("a{i}: &a{i} [{names}]\n"));
    }
    text + &format!("{key}: *a8\n")
}
