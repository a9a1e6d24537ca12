//! Prints what bags hold: topics, types, counts, times and problems. Reads every message, so problems are complete.
//!
//! `cargo run --release -p storm-node --example bag_info -- BAG...`

use std::path::Path;
use std::time::Instant;

use storm_node::bag::{Bag, BagError};
use storm_node::cdr::decode;

fn main() {
    let mut refused = false;
    for arg in std::env::args().skip(1) {
        println!("== {arg}");
        if let Err(e) = show(Path::new(&arg)) {
            println!("refused: {e}");
            refused = true;
        }
    }
    std::process::exit(if refused { 2 } else { 0 });
}

fn show(path: &Path) -> Result<(), BagError> {
    let start = Instant::now();
    let bag = Bag::open(path)?;
    let opened = start.elapsed();
    let readable: Vec<usize> = (0..bag.topics().len()).filter(|i| bag.topics()[*i].is_readable()).collect();
    let mut read = vec![(0u64, 0u64, 0u64); bag.topics().len()];
    let (mut last, mut out_of_order, mut failed) = (i64::MIN, 0u64, 0u64);
    for message in bag.messages(&readable)? {
        match message {
            Ok(m) => {
                out_of_order += u64::from(m.log_time_ns < last);
                last = m.log_time_ns;
                let (n, bytes, bad) = &mut read[m.topic];
                *n += 1;
                *bytes += m.data.len() as u64;
                *bad += u64::from(decodes(&bag.topics()[m.topic].type_name, &m.data) == Some(false));
            }
            Err(e) => {
                failed += 1;
                println!("  message: {e}");
            }
        }
    }
    for (t, (n, bytes, bad)) in bag.topics().iter().zip(&read) {
        println!(
            "  {:6} indexed {n:6} read {bytes:10} bytes  {bad} undecodable  {} [{}] {}",
            t.count, t.name, t.type_name, t.serialization
        );
    }
    println!(
        "  files {}  messages {}  {:?}..{:?} ns  out of order {out_of_order}  failed {failed}  open {:.1} ms, all {:.1} ms",
        bag.files().count(),
        bag.message_count(),
        bag.start_ns(),
        bag.end_ns(),
        opened.as_secs_f64() * 1e3,
        start.elapsed().as_secs_f64() * 1e3,
    );
    for p in bag.problems() {
        println!("  problem: {p}");
    }
    Ok(())
}

/// Whether a message of a known type decodes; `None` for other types.
fn decodes(type_name: &str, data: &[u8]) -> Option<bool> {
    match type_name {
        "sensor_msgs/msg/Image" => Some(decode::image(data).is_ok()),
        "sensor_msgs/msg/CompressedImage" => Some(decode::compressed_image(data).is_ok()),
        "sensor_msgs/msg/CameraInfo" => Some(decode::camera_info(data).is_ok()),
        "tf2_msgs/msg/TFMessage" => Some(decode::tf_message(data).is_ok()),
        t if decode::POSE_TYPES.contains(&t) => Some(decode::pose(t, data).is_ok()),
        _ => None,
    }
}
