//! Clips from recordings, alone or between those of procedural drives. What a recording is (a bag, a folder) is another
//! crate's business: here it is a number of places a clip can start at, each with moments its targets can be taken at.

use std::sync::Arc;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::clips::TrainClip;
use super::error::TrainError;
use super::loader::{DataOptions, KeptClips};
use crate::config::ModelConfig;

/// Keeps the choice of a batch's source apart from the choice of its clips, which have the same seed.
const CHOICE: u64 = 0x5354_4f52_4d42_4147;

/// Batches by number, the same ones whenever and on whatever thread they are made.
pub trait Batches: Send + Sync {
    /// Batch `index` of the run; `kept` holds clips that will be shown again.
    fn batch_with(&self, index: u64, config: &ModelConfig, kept: &KeptClips) -> Result<TrainClip, TrainError>;
}

/// A recording clips are cut from.
pub trait ClipSource: Send + Sync {
    /// Places a clip can start at; at least 1.
    fn starts(&self) -> usize;
    /// Moments within the span of the clip at `start` that target pictures can be taken at; at least 1.
    fn moments(&self, start: usize) -> usize;
    /// The clip at `start` with target pictures at these moments (none: no targets). `one_camera` leaves only the one the
    /// anchor sits at.
    fn clip(
        &self,
        start: usize,
        moments: &[usize],
        one_camera: bool,
        config: &ModelConfig,
    ) -> Result<TrainClip, TrainError>;
}

/// Which recordings a run learns from; stored in checkpoints.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordingOptions {
    /// The bags as they were named.
    pub bags: Vec<String>,
    /// Share of the batches that are cut from bags, more than 0, at most 1; the others are procedural drives.
    pub share: f64,
    /// Clips start at least this long after a bag's first synchronized set, seconds.
    pub from_sec: f64,
    /// Nothing later than this after a bag's first synchronized set is used, seconds; none: to the end.
    pub to_sec: Option<f64>,
    /// Use only a rig's first cameras; none: all.
    pub cameras: Option<usize>,
    /// Configuration file for the bags' topics, as `storm replay --config` takes it.
    pub config: Option<String>,
}

impl RecordingOptions {
    /// Refuses what cannot be trained with.
    pub fn check(&self) -> Result<(), TrainError> {
        let rule = |ok: bool, name, value: f64, allowed| {
            if ok { Ok(()) } else { Err(TrainError::Option { name, value: value.to_string(), allowed }) }
        };
        rule(!self.bags.is_empty(), "bag", 0.0, "at least one bag")?;
        rule(self.share > 0.0 && self.share <= 1.0, "bag-share", self.share, "more than 0, at most 1")?;
        rule(self.from_sec >= 0.0 && self.from_sec.is_finite(), "from-sec", self.from_sec, "0 or a positive number")?;
        let to = self.to_sec.unwrap_or(f64::MAX);
        rule(to > self.from_sec, "to-sec", to, "a number greater than from-sec")?;
        let cameras = self.cameras.unwrap_or(1);
        rule((1..=6).contains(&cameras), "bag-cameras", cameras as f64, "1 to 6")
    }

    /// For the metadata of weights: names only, no places.
    pub fn describe(&self) -> String {
        let name = |bag: &String| {
            let name = std::path::Path::new(bag).file_name();
            name.map_or_else(|| "a bag".into(), |n| n.to_string_lossy().into_owned())
        };
        let names: Vec<String> = self.bags.iter().map(name).collect();
        let to = self.to_sec.map_or_else(|| "the end".into(), |to| format!("{to} s"));
        let drives = if self.share < 1.0 { "" } else { "; no drives" };
        format!(
            "{:.0} % of the batches from recordings ({}, {} s to {to}), self-supervised where they have no ground truth{drives}",
            100.0 * self.share,
            names.join(", "),
            self.from_sec
        )
    }
}

/// Batches of drives and recordings. A batch is of one kind and of one recording, so that numbers of cameras may differ.
#[derive(Clone)]
pub struct MixedData {
    /// The drives, and seed and size of all batches.
    pub drives: DataOptions,
    /// The recordings; none: drives only.
    pub recordings: Vec<Arc<dyn ClipSource>>,
    /// Share of the batches that are cut from recordings.
    pub share: f64,
}

/// A clip of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Pick {
    pub recording: usize,
    pub start: usize,
    pub moments: Vec<usize>,
}

impl MixedData {
    /// The clips of batch `index`, or `None` where it belongs to the drives. Recordings come up as often as they have
    /// places to start at.
    pub(super) fn picks(&self, index: u64) -> Option<Vec<Pick>> {
        let DataOptions { seed, batch, .. } = &self.drives;
        let targets = self.drives.targets(index);
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ CHOICE ^ (index + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let total: usize = self.recordings.iter().map(|r| r.starts()).sum();
        let recorded = total > 0 && rng.random::<f64>() < self.share;
        if !recorded {
            return None;
        }
        let mut at = rng.random_range(0..total);
        let recording = self.recordings.iter().position(|r| {
            let here = at < r.starts();
            at = at.saturating_sub(r.starts());
            here
        })?;
        let source = &self.recordings[recording];
        let mut pick = || {
            let start = rng.random_range(0..source.starts());
            let choice = source.moments(start).max(1);
            let mut moments: Vec<usize> = (0..targets).map(|_| rng.random_range(0..choice)).collect();
            moments.sort_unstable();
            Pick { recording, start, moments }
        };
        Some((0..*batch).map(|_| pick()).collect())
    }
}

impl Batches for MixedData {
    fn batch_with(&self, index: u64, config: &ModelConfig, kept: &KeptClips) -> Result<TrainClip, TrainError> {
        let Some(picks) = self.picks(index) else {
            return Batches::batch_with(&self.drives, index, config, kept);
        };
        let one_camera = index < self.drives.one_camera_batches;
        let made = picks
            .iter()
            .map(|p| self.recordings[p.recording].clip(p.start, &p.moments, one_camera, config))
            .collect::<Result<Vec<_>, _>>()?;
        TrainClip::stack(&made)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::ClipOptions;

    struct Counts(usize, usize);

    impl ClipSource for Counts {
        fn starts(&self) -> usize {
            self.0
        }
        fn moments(&self, _: usize) -> usize {
            self.1
        }
        fn clip(&self, _: usize, _: &[usize], _: bool, _: &ModelConfig) -> Result<TrainClip, TrainError> {
            Err(TrainError::Source("counted only".into()))
        }
    }

    fn mixed(share: f64) -> MixedData {
        let drives = DataOptions {
            seed: 4,
            batch: 3,
            clips: ClipOptions::default(),
            one_camera_batches: 0,
            targets_from: 0,
            reuse: 1,
        };
        MixedData { drives, recordings: vec![Arc::new(Counts(30, 20)), Arc::new(Counts(10, 5))], share }
    }

    #[test]
    fn picks_follow_the_shares_and_depend_on_seed_and_index_only() {
        let mixed = mixed(0.5);
        let picks: Vec<_> = (0..2000).map(|k| mixed.picks(k)).collect();
        assert!((0..2000).all(|k| picks[k as usize] == mixed.picks(k)));
        let recorded: Vec<&Pick> = picks.iter().flatten().flatten().collect();
        let batches = picks.iter().flatten().count();
        assert!((900..1100).contains(&batches), "{batches} of 2000 at a share of a half");
        let first = recorded.iter().filter(|p| p.recording == 0).count() as f64 / recorded.len() as f64;
        assert!((first - 0.75).abs() < 0.05, "three quarters of the starts, {first} of the clips");
        for p in &recorded {
            let source = &mixed.recordings[p.recording];
            assert!(p.start < source.starts() && p.moments.len() == 4);
            assert!(p.moments.is_sorted() && p.moments.iter().all(|&m| m < source.moments(p.start)));
        }
        assert!((0..30).all(|s| recorded.iter().any(|p| p.recording == 0 && p.start == s)));
        let other = MixedData { drives: DataOptions { seed: 5, ..mixed.drives.clone() }, ..mixed.clone() };
        assert!((0..100).any(|k| other.picks(k) != picks[k as usize]));
    }

    #[test]
    fn a_share_of_one_is_recordings_only_and_none_is_drives_only() {
        assert!((0..200).all(|k| mixed(1.0).picks(k).is_some()));
        let none = MixedData { recordings: Vec::new(), ..mixed(1.0) };
        assert!((0..200).all(|k| none.picks(k).is_none()));
        assert!(matches!(
            mixed(1.0).batch_with(0, &ModelConfig::default(), &KeptClips::default()),
            Err(TrainError::Source(_))
        ));
    }

    #[test]
    fn options_outside_their_range_are_refused() {
        let good = RecordingOptions {
            bags: vec!["/data/run 7".into()],
            share: 1.0,
            from_sec: 0.0,
            to_sec: None,
            cameras: None,
            config: None,
        };
        good.check().unwrap();
        assert!(good.describe().contains("run 7") && !good.describe().contains("/data"));
        for bad in [
            RecordingOptions { bags: Vec::new(), ..good.clone() },
            RecordingOptions { share: 0.0, ..good.clone() },
            RecordingOptions { share: f64::NAN, ..good.clone() },
            RecordingOptions { from_sec: f64::NAN, ..good.clone() },
            RecordingOptions { to_sec: Some(f64::NAN), ..good.clone() },
            RecordingOptions { from_sec: 3.0, to_sec: Some(2.0), ..good.clone() },
            RecordingOptions { cameras: Some(7), ..good.clone() },
        ] {
            assert!(bad.check().is_err(), "{bad:?}");
        }
    }
}
