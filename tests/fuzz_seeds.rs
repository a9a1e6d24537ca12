//! The fuzz targets without a fuzzer: every target over its seeds, their beginnings, and some thousands of mutations from a
//! fixed seed. What libFuzzer finds in hours becomes a test beside its parser; this keeps the targets themselves sound.
#![allow(clippy::unwrap_used, clippy::expect_used)]

#[path = "fuzz/src/seeds.rs"]
#[allow(missing_docs)]
mod seeds;
#[path = "fuzz/src/targets/mod.rs"]
mod targets;

use std::panic::{AssertUnwindSafe, catch_unwind};

use storm_node::dice::Dice;

/// Numbers that lie at the limits of something.
const EDGES: [u64; 10] = [0, 1, 0x7f, 0x80, 0xffff, 0x7fff_ffff, 0xffff_ffff, 1 << 40, i64::MAX as u64, u64::MAX];

fn mutated(dice: &mut Dice, seeds: &[Vec<u8>]) -> Vec<u8> {
    let mut pick = |n: usize| dice.below(n);
    let mut bytes = seeds[pick(seeds.len())].clone();
    for _ in 0..1 + pick(6) {
        if bytes.is_empty() {
            break;
        }
        let at = pick(bytes.len());
        match pick(7) {
            0 => bytes[at] ^= 1 << pick(8),
            1 => bytes[at] = pick(256) as u8,
            2 => bytes.truncate(at),
            3 => {
                let edge = EDGES[pick(EDGES.len())].to_le_bytes();
                let width = [1, 2, 4, 8][pick(4)].min(bytes.len() - at);
                bytes[at..at + width].copy_from_slice(&edge[..width]);
            }
            4 => {
                let end = (at + 1 + pick(64)).min(bytes.len());
                let piece = bytes[at..end].to_vec();
                bytes.splice(at..at, piece);
            }
            5 => {
                let end = (at + 1 + pick(64)).min(bytes.len());
                bytes.drain(at..end);
            }
            _ => {
                let other = &seeds[pick(seeds.len())];
                let from = pick(other.len().max(1)).min(other.len());
                bytes.truncate(at);
                bytes.extend_from_slice(&other[from..]);
            }
        }
    }
    bytes
}

fn exercise(name: &str, target: fn(&[u8]), seeds: Vec<Vec<u8>>, mutations: usize) {
    let run = |bytes: &[u8]| {
        if catch_unwind(AssertUnwindSafe(|| target(bytes))).is_err() {
            let path = std::env::temp_dir().join(format!("storm-{name}-failed"));
            std::fs::write(&path, bytes).unwrap();
            panic!("{name}: these {} bytes panic: {}", bytes.len(), path.display());
        }
    };
    run(&[]);
    for seed in &seeds {
        run(seed);
        (1..16).for_each(|k| run(&seed[..seed.len() * k / 16]));
    }
    let mut dice = Dice::new(11);
    (0..mutations).for_each(|_| run(&mutated(&mut dice, &seeds)));
    // The same without end, for as long as asked: fuzzing without a fuzzer.
    let variable = |name: &str| std::env::var(name).ok().and_then(|text| text.parse::<u64>().ok());
    let Some(seconds) = variable("STORM_FUZZ_SECONDS") else { return };
    let (start, mut dice) = (std::time::Instant::now(), Dice::new(variable("STORM_FUZZ_SEED").unwrap_or(1)));
    let (mut done, mut slowest_ms) = (0u64, 0);
    while start.elapsed().as_secs() < seconds {
        let bytes = mutated(&mut dice, &seeds);
        let before = std::time::Instant::now();
        run(&bytes);
        slowest_ms = slowest_ms.max(before.elapsed().as_millis());
        done += 1;
    }
    println!("{name}: {done} executions in {seconds} s, the slowest {slowest_ms} ms");
}

/// Writes the seeds where a fuzzer wants them: one folder per target in `STORM_FUZZ_CORPUS`.
#[test]
#[ignore = "writes files; run with --ignored and STORM_FUZZ_CORPUS set"]
fn seeds_to_folders() {
    let folder =
        std::path::PathBuf::from(std::env::var_os("STORM_FUZZ_CORPUS").expect("STORM_FUZZ_CORPUS is a folder"));
    for (name, seeds) in [
        ("bag", seeds::bag()),
        ("cdr", seeds::cdr()),
        ("image", seeds::image()),
        ("compressed", seeds::compressed()),
        ("weights", seeds::weights()),
        ("map", seeds::map()),
        ("config", seeds::config()),
        ("front", seeds::front()),
    ] {
        std::fs::create_dir_all(folder.join(name)).unwrap();
        for (i, seed) in seeds.iter().enumerate() {
            std::fs::write(folder.join(name).join(format!("seed{i:02}")), seed).unwrap();
        }
    }
}

#[test]
fn bags() {
    exercise("bag", targets::bag, seeds::bag(), 1500);
}

#[test]
fn messages() {
    exercise("cdr", targets::cdr, seeds::cdr(), 4000);
}

#[test]
fn pictures() {
    exercise("image", targets::image, seeds::image(), 6000);
}

#[test]
fn compressed_pictures() {
    exercise("compressed", targets::compressed, seeds::compressed(), 6000);
}

#[test]
fn weights() {
    exercise("weights", targets::weights, seeds::weights(), 4000);
}

#[test]
fn saved_maps() {
    exercise("map", targets::map, seeds::map(), 3000);
}

#[test]
fn configurations() {
    exercise("config", targets::config, seeds::config(), 2000);
}

#[test]
fn events() {
    exercise("front", targets::front, seeds::front(), 4000);
}
