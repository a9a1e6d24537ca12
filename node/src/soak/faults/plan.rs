//! What goes wrong when: drawn frame by frame from a seed.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};
use std::time::Duration;

use crate::dice::Dice;
use crate::pipeline::step::{OnPart, Part};

/// The parts a panic is injected into.
const PARTS: [Part; 6] = [Part::Gate, Part::Network, Part::Overlap, Part::Draw, Part::Map, Part::Follow];
/// A part to panic in is asked for by its number; this asks for none.
const NONE: u8 = u8::MAX;
/// How long a slow disk keeps a save waiting.
const SLOW_SAVE: Duration = Duration::from_millis(300);

/// What the plan tells the step thread.
#[derive(Debug)]
pub struct Orders {
    panic_in: AtomicU8,
    slow: AtomicU64,
    /// Panics that happened.
    pub panics: AtomicU64,
}

impl Orders {
    pub fn new() -> Arc<Self> {
        Arc::new(Self { panic_in: AtomicU8::new(NONE), slow: AtomicU64::new(0), panics: AtomicU64::new(0) })
    }

    /// Obeys, on the step thread.
    pub fn on_part(self: Arc<Self>) -> OnPart {
        Box::new(move |part| {
            if part == Part::Save && self.slow.load(Ordering::Relaxed) > 0 {
                std::thread::sleep(SLOW_SAVE);
            }
            let number = PARTS.iter().position(|p| *p == part).map_or(NONE - 1, |n| n as u8);
            if self.panic_in.compare_exchange(number, NONE, Ordering::Relaxed, Ordering::Relaxed).is_ok() {
                self.panics.fetch_add(1, Ordering::Relaxed);
                panic!("injected into {part:?}");
            }
        })
    }

    pub fn set_slow(&self, slow: bool) {
        self.slow.store(u64::from(slow), Ordering::Relaxed);
    }

    /// Takes back a panic that has not happened.
    pub fn calm(&self) {
        self.panic_in.store(NONE, Ordering::Relaxed);
    }
}

/// What is done to one image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Spoil {
    None,
    /// Not sent.
    Missing,
    /// Sent so many frames later.
    Late(usize),
    /// Sent twice.
    Duplicate,
    /// Some bytes changed, or the end cut off.
    Corrupt,
    /// A picture of floats that are not numbers.
    Poison,
    /// Sent to a decoder that panics.
    Panic,
}

/// What is done to one pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PoseSpoil {
    None,
    Missing,
    /// Not numbers.
    Nan,
    /// So far to the side, metres.
    Jump(f64),
}

/// One frame's faults.
#[derive(Debug, Clone)]
pub struct Frame {
    pub images: Vec<Spoil>,
    pub pose: PoseSpoil,
    /// Cameras are sent in falling order, after the next frame's pose.
    pub reordered: bool,
    /// Added to the clock from here on, nanoseconds.
    pub clock_ns: i64,
    /// Sent without waiting for the frames before.
    pub burst: bool,
    /// The disk is full.
    pub disk_full: bool,
}

/// Chances per frame; episodes last up to so many frames.
const MISSING: (f32, usize) = (0.01, 25);
const POSE_GAP: (f32, usize) = (0.004, 15);
const BURST: (f32, usize) = (0.008, 30);
const DISK_FULL: (f32, usize) = (0.004, 60);
const SLOW_DISK: (f32, usize) = (0.004, 60);
const LATE: f32 = 0.01;
const DUPLICATE: f32 = 0.01;
const CORRUPT: f32 = 0.01;
const POISON: f32 = 0.01;
const DECODER_PANIC: f32 = 0.004;
const POSE_NAN: f32 = 0.01;
const POSE_JUMP: f32 = 0.005;
const REORDERED: f32 = 0.01;
const CLOCK: f32 = 0.004;
const PART_PANIC: f32 = 0.01;
/// Frames without injected panics at the end, so that none waits when the run is judged.
const CALM: usize = 20;

/// Draws faults.
pub struct Plan {
    dice: Dice,
    cameras: usize,
    frames: usize,
    missing: Vec<usize>,
    pose_gap: usize,
    burst: usize,
    disk_full: usize,
    slow_disk: usize,
    disk: bool,
    orders: Arc<Orders>,
    /// Faults so far, by kind.
    pub injected: BTreeMap<&'static str, u64>,
}

impl Plan {
    /// For so many frames of so many cameras; `disk`: whether the disk may be full.
    pub fn new(seed: u64, cameras: usize, frames: usize, disk: bool, orders: Arc<Orders>) -> Self {
        Self {
            dice: Dice::new(seed ^ 0xfa17),
            cameras,
            frames,
            missing: vec![0; cameras],
            pose_gap: 0,
            burst: 0,
            disk_full: 0,
            slow_disk: 0,
            disk,
            orders,
            injected: BTreeMap::new(),
        }
    }

    fn chance(&mut self, kind: &'static str, p: f32) -> bool {
        let hit = self.dice.unit() < p;
        if hit {
            *self.injected.entry(kind).or_default() += 1;
        }
        hit
    }

    /// An episode that runs or begins; `left` is counted down.
    fn episode(&mut self, kind: &'static str, (p, most): (f32, usize), left: usize) -> usize {
        match left {
            0 if self.chance(kind, p) => 1 + self.dice.below(most),
            n => n.saturating_sub(1),
        }
    }

    /// A random spoiling of bytes.
    pub fn corrupt(&mut self, bytes: &mut Vec<u8>) {
        if self.dice.below(3) == 0 {
            bytes.truncate(self.dice.below(bytes.len()));
            return;
        }
        for _ in 0..1 + self.dice.below(4) {
            // Mostly in the header, where it hurts.
            let most = if self.dice.below(3) > 0 { 64 } else { usize::MAX };
            let at = self.dice.below(bytes.len().min(most));
            if let Some(byte) = bytes.get_mut(at) {
                *byte = self.dice.bits() as u8;
            }
        }
    }

    /// The faults of frame number `frame`.
    pub fn frame(&mut self, frame: usize) -> Frame {
        let calm = frame + CALM >= self.frames;
        let mut images = Vec::with_capacity(self.cameras);
        for camera in 0..self.cameras {
            self.missing[camera] = self.episode("missing", MISSING, self.missing[camera]);
            images.push(if self.missing[camera] > 0 {
                Spoil::Missing
            } else if self.chance("late", LATE) {
                Spoil::Late(1 + self.dice.below(20))
            } else if self.chance("duplicate", DUPLICATE) {
                Spoil::Duplicate
            } else if self.chance("corrupt", CORRUPT) {
                Spoil::Corrupt
            } else if self.chance("poison", POISON) {
                Spoil::Poison
            } else if self.chance("decoder_panic", DECODER_PANIC) {
                Spoil::Panic
            } else {
                Spoil::None
            });
        }
        self.pose_gap = self.episode("pose_gap", POSE_GAP, self.pose_gap);
        let pose = if self.pose_gap > 0 {
            PoseSpoil::Missing
        } else if self.chance("pose_nan", POSE_NAN) {
            PoseSpoil::Nan
        } else if self.chance("pose_jump", POSE_JUMP) {
            PoseSpoil::Jump(f64::from(self.dice.unit()) * 2000.0 - 1000.0)
        } else {
            PoseSpoil::None
        };
        self.burst = self.episode("burst", BURST, self.burst);
        if self.disk {
            self.disk_full = self.episode("disk_full", DISK_FULL, self.disk_full);
        }
        self.slow_disk = self.episode("slow_disk", SLOW_DISK, self.slow_disk);
        self.orders.set_slow(self.slow_disk > 0 && !calm);
        if !calm && self.chance("panic", PART_PANIC) {
            self.orders.panic_in.store(self.dice.below(PARTS.len()) as u8, Ordering::Relaxed);
        } else if calm {
            self.orders.calm();
        }
        let clock_ns = match self.chance("clock", CLOCK) {
            true => (f64::from(self.dice.unit() - 0.5) * 200e9) as i64,
            false => 0,
        };
        let reordered = self.chance("reordered", REORDERED);
        let disk_full = self.disk_full > 0 && !calm;
        Frame { images, pose, reordered, clock_ns, burst: self.burst > 0 && !calm, disk_full }
    }
}
