//! MCAP files written with the `mcap` crate in every form, then cut, damaged and read back.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::Path;

use ::mcap::records::MessageHeader;
use ::mcap::{Compression, WriteOptions};
use proptest::prelude::*;

use super::{McapIndex, McapStream};
use crate::bag::problems::Problems;
use crate::bag::{Bag, BagError, RawMessage};

/// Messages in the sample file.
const MESSAGES: u32 = 300;

/// CDR-looking payload of message `i`.
fn payload(i: u32) -> Vec<u8> {
    let mut v = vec![0, 1, 0, 0];
    v.extend(i.to_le_bytes());
    v.extend((0..(i % 40)).map(|k| (k * 7 + i) as u8));
    v
}

/// Log time of message `i`: neighbours swapped and every fifth pair tied, so that order is not write order.
fn log_time(i: u32) -> u64 {
    let i = if i % 5 == 4 { i - 1 } else { i ^ 1 };
    1_000 + u64::from(i) * 10
}

fn sample(options: WriteOptions) -> Vec<u8> {
    let mut writer = options.create(Cursor::new(Vec::new())).unwrap();
    let schema = writer.add_schema("std_msgs/msg/String", "ros2msg", b"string data").unwrap();
    let ids: Vec<u16> =
        ["/a", "/b", "/c"].iter().map(|t| writer.add_channel(schema, t, "cdr", &BTreeMap::new()).unwrap()).collect();
    for i in 0..MESSAGES {
        let head = MessageHeader {
            channel_id: ids[i as usize % 3],
            sequence: i,
            log_time: log_time(i),
            publish_time: log_time(i),
        };
        writer.write_to_known_channel(&head, &payload(i)).unwrap();
    }
    writer.finish().unwrap();
    writer.into_inner().into_inner()
}

fn forms() -> Vec<(&'static str, WriteOptions)> {
    let base = || WriteOptions::new().profile("ros2").chunk_size(Some(1_500));
    vec![
        ("zstd", base().compression(Some(Compression::Zstd))),
        ("lz4", base().compression(Some(Compression::Lz4))),
        ("none", base().compression(None)),
        ("unchunked", base().use_chunks(false)),
        ("zstd, no summary", base().compression(Some(Compression::Zstd)).emit_summary_records(false)),
        ("lz4, no chunk index", base().compression(Some(Compression::Lz4)).emit_chunk_indexes(false)),
        ("no message index", base().compression(None).emit_message_indexes(false)),
        ("unchunked, no summary", base().use_chunks(false).emit_summary_records(false)),
        ("channels only inside chunks", base().compression(None).repeat_channels(false).repeat_schemas(false)),
    ]
}

fn read_all(path: &Path) -> Result<(Bag, Vec<RawMessage>), BagError> {
    let bag = Bag::open(path)?;
    let all: Vec<usize> = (0..bag.topics().len()).collect();
    let messages = bag.messages(&all)?.collect::<Result<Vec<_>, _>>()?;
    Ok((bag, messages))
}

/// Index of the sample's messages in the order they must come out.
fn expected() -> Vec<u32> {
    let mut order: Vec<u32> = (0..MESSAGES).collect();
    order.sort_by_key(|i| log_time(*i));
    order
}

#[test]
fn every_form_gives_every_message_in_log_time_order() {
    let dir = tempfile::tempdir().unwrap();
    for (name, options) in forms() {
        let path = dir.path().join("x.mcap");
        std::fs::write(&path, sample(options)).unwrap();
        let (bag, messages) = read_all(&path).unwrap();
        assert_eq!(bag.problems(), Vec::<String>::new(), "{name}");
        assert_eq!(bag.topics().iter().map(|t| t.count).collect::<Vec<_>>(), [100, 100, 100], "{name}");
        assert_eq!(bag.topics()[0].type_name, "std_msgs/msg/String", "{name}");
        assert_eq!((bag.start_ns(), bag.end_ns()), (Some(1_000), Some(3_990)), "{name}");
        let got: Vec<Vec<u8>> = messages.into_iter().map(|m| m.data).collect();
        assert_eq!(got, expected().into_iter().map(payload).collect::<Vec<_>>(), "{name}");
        let some: Vec<RawMessage> = bag.messages(&[1]).unwrap().map(Result::unwrap).collect();
        assert!(some.len() == 100 && some.iter().all(|m| m.topic == 1), "{name}");
    }
}

#[test]
fn a_small_cache_reads_chunks_again_and_gives_the_same() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("x.mcap");
    // Every chunk spans all times: message i of 0..40 goes to time (i * 17) % 40.
    let mut writer = WriteOptions::new().chunk_size(Some(200)).create(Cursor::new(Vec::new())).unwrap();
    let channel = writer.add_channel(0, "/a", "cdr", &BTreeMap::new()).unwrap();
    for i in 0..400u32 {
        let t = u64::from(i * 17 % 40);
        let head = MessageHeader { channel_id: channel, sequence: i, log_time: t, publish_time: t };
        writer.write_to_known_channel(&head, &payload(i)).unwrap();
    }
    writer.finish().unwrap();
    std::fs::write(&path, writer.into_inner().into_inner()).unwrap();
    let problems = Problems::default();
    let index = std::sync::Arc::new(McapIndex::open(&path, &problems).unwrap());
    let read = |cache: usize| {
        let stream = McapStream::open(index.clone(), vec![true], problems.clone()).unwrap();
        let mut stream = stream.with_cache_bytes(cache);
        let mut out = Vec::new();
        while let Some(m) = stream.next_message() {
            let m = m.unwrap();
            out.push((m.log_time_ns, m.data));
        }
        out
    };
    let plenty = read(usize::MAX);
    assert_eq!(plenty.len(), 400);
    assert!(plenty.is_sorted_by_key(|m| m.0));
    assert_eq!(read(1), plenty);
    assert_eq!(problems.lines(), Vec::<String>::new());
}

#[test]
fn cut_files_give_what_comes_before_the_cut() {
    let dir = tempfile::tempdir().unwrap();
    for (form, (name, options)) in forms().into_iter().enumerate() {
        let whole = sample(options);
        let mut last = 0;
        // A prime stride visits all kinds of places; the last bytes hold the summary and the footer.
        let tail = whole.len() - 60;
        for cut in (8..tail).step_by(83).chain(tail..whole.len()) {
            // A new file each time: writing over one makes some file systems wait for the disk.
            let path = dir.path().join(format!("{form}_{cut}.mcap"));
            std::fs::write(&path, &whole[..cut]).unwrap();
            let (bag, messages) = read_all(&path).unwrap_or_else(|e| panic!("{name} cut at {cut}: {e}"));
            assert!(messages.len() >= last, "{name}: {} messages at {cut}, {last} before", messages.len());
            assert_eq!(messages.len() as u64, bag.message_count(), "{name} at {cut}");
            assert!(messages.is_sorted_by_key(|m| m.log_time_ns), "{name} at {cut}");
            assert!(!bag.problems().is_empty(), "{name} at {cut}");
            last = messages.len();
        }
        assert_eq!(last, MESSAGES as usize, "{name}");
    }
}

#[test]
fn a_damaged_chunk_costs_only_itself() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("x.mcap");
    let options = WriteOptions::new().chunk_size(Some(1_500)).compression(None);
    let whole = sample(options.clone());
    let index = McapIndex::open(write(&path, &whole), &Problems::default()).unwrap();
    let chunk = index.chunks[2].offset as usize;
    let mut bad = whole;
    bad[chunk + 400] ^= 0x55;
    write(&path, &bad);
    let (bag, messages) = read_all(&path).unwrap();
    let problems = bag.problems().join("\n");
    assert!(problems.contains(&format!("chunk at byte {chunk}: checksum")), "{problems}");
    assert!(problems.contains("topic /a:") && problems.contains("of 100 messages"), "{problems}");
    let (lost, per_chunk) = (MESSAGES as usize - messages.len(), MESSAGES as usize / index.chunks.len() + 10);
    assert!(lost > 0 && lost <= per_chunk, "{lost} lost");
}

fn write<'a>(path: &'a Path, bytes: &[u8]) -> &'a Path {
    std::fs::write(path, bytes).unwrap();
    path
}

#[test]
fn other_profiles_and_encodings_are_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("x.mcap");
    write(&path, &sample(WriteOptions::new().profile("ros1")));
    let e = Bag::open(&path).unwrap_err();
    assert!(matches!(e, BagError::Serialization { .. }) && e.to_string().contains("`ros1`"), "{e}");

    let mixed = |encodings: &[&str]| {
        let mut writer = WriteOptions::new().create(Cursor::new(Vec::new())).unwrap();
        for (i, encoding) in encodings.iter().enumerate() {
            let id = writer.add_channel(0, &format!("/t{i}"), encoding, &BTreeMap::new()).unwrap();
            let head = MessageHeader { channel_id: id, sequence: 0, log_time: 5, publish_time: 5 };
            writer.write_to_known_channel(&head, b"\0\x01\0\0").unwrap();
        }
        writer.finish().unwrap();
        writer.into_inner().into_inner()
    };
    write(&path, &mixed(&["json", "protobuf"]));
    let e = Bag::open(&path).unwrap_err().to_string();
    assert!(e.contains("`json`, `protobuf`") && e.contains("accepted: message encoding `cdr`"), "{e}");

    write(&path, &mixed(&["json", "cdr"]));
    let bag = Bag::open(&path).unwrap();
    assert!(bag.problems()[0].contains("topic /t0: serialization `json`"));
    assert_eq!(bag.topic("/t0"), None);
    let e = bag.messages(&[0]).err().unwrap();
    assert!(matches!(e, BagError::TopicSerialization { .. }), "{e}");
    assert_eq!(bag.messages(&[1]).unwrap().count(), 1);
    assert!(matches!(bag.messages(&[7]), Err(BagError::NoSuchTopic { index: 7, count: 2 })));
}

#[test]
fn claimed_sizes_are_not_believed() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("x.mcap");
    let head = [&b"\x89MCAP0\r\n"[..], &[1, 8, 0, 0, 0, 0, 0, 0, 0], &[0; 8]].concat();
    let chunk = |uncompressed: u64, compressed: u64| {
        let body = [&[0u8; 16][..], &uncompressed.to_le_bytes(), &[0; 8], &compressed.to_le_bytes()].concat();
        [&head[..], &[6], &(body.len() as u64 + compressed.min(1 << 40)).to_le_bytes(), &body].concat()
    };
    for bytes in [chunk(100 << 30, 100 << 30), chunk(100 << 30, 4), chunk(4, u64::MAX), chunk(u64::MAX, u64::MAX)] {
        write(&path, &bytes);
        let (bag, messages) = read_all(&path).unwrap();
        assert!(
            messages.is_empty() && bag.problems().iter().any(|p| p.contains("chunk at byte")),
            "{:?}",
            bag.problems()
        );
    }
    // A schema of 2^60 bytes.
    write(&path, &[&head[..], &[3], &(1u64 << 60).to_le_bytes(), &[0; 20]].concat());
    assert!(Bag::open(&path).unwrap().problems().iter().any(|p| p.contains("record 0x03 at byte 25 claims")));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(150))]

    #[test]
    fn damage_anywhere_never_panics(form in 0usize..9, at in 0.0f64..1.0, flips in proptest::collection::vec((0usize..64, any::<u8>()), 1..6)) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("x.mcap");
        let mut bytes = sample(forms().swap_remove(form).1);
        let base = (at * bytes.len() as f64) as usize;
        for (offset, value) in flips {
            if let Some(b) = bytes.get_mut(base + offset) {
                *b = value;
            }
        }
        write(&path, &bytes);
        if let Ok(bag) = Bag::open(&path) {
            let readable: Vec<usize> = (0..bag.topics().len()).filter(|i| bag.topics()[*i].is_readable()).collect();
            prop_assert!(bag.messages(&readable).unwrap().count() <= MESSAGES as usize + 1);
        }
    }

    #[test]
    fn random_bytes_never_panic(magic in 0usize..4, tail in proptest::collection::vec(any::<u8>(), 0..300)) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("x.mcap");
        let magic: &[u8] = [&b"\x89MCAP0\r\n"[..], b"SQLite format 3\0", &[0x28, 0xb5, 0x2f, 0xfd], b""][magic];
        write(&path, &[magic, &tail].concat());
        if let Ok(bag) = Bag::open(&path) {
            let readable: Vec<usize> = (0..bag.topics().len()).filter(|i| bag.topics()[*i].is_readable()).collect();
            let _ = bag.messages(&readable).map(Iterator::count);
        }
    }
}

#[test]
fn an_index_that_lies_about_times_costs_the_order_and_is_said() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("x.mcap");
    let options = WriteOptions::new().chunk_size(Some(1_500)).compression(None).calculate_summary_section_crc(false);
    let mut bytes = sample(options);
    // The first chunk's line of the index: opcode, length, then when the chunk begins (the sample's first time).
    let line = (0..bytes.len() - 17)
        .rev()
        .filter(|&i| bytes[i] == super::records::op::CHUNK_INDEX && bytes[i + 9..i + 17] == 1_000u64.to_le_bytes())
        .find(|&i| u64::from_le_bytes(std::array::from_fn(|k| bytes[i + 1 + k])) < 1_000)
        .unwrap();
    bytes[line + 9..line + 17].copy_from_slice(&3_000u64.to_le_bytes());
    std::fs::write(&path, bytes).unwrap();
    let (bag, messages) = read_all(&path).unwrap();
    assert_eq!(messages.len(), MESSAGES as usize, "all the same, every message is read");
    assert!(bag.problems().iter().any(|line| line.contains("out of order")), "{:?}", bag.problems());
}
