//! What `storm train` learns from besides drives: bags, and a feature network for the perceptual term.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result};
use candle_core::Device;
use storm_model::Storm;
use storm_model::train::{
    ClipOptions, ClipSource, FeatureNetwork, MixedData, RecordingOptions, Stage, TrainOptions, Trainer, held_pictures,
};
use tracing::{info, warn};

use super::bags::{BagClips, BagOptions, open_all};
use super::curves::Table;
use crate::cmd::UsageError;

/// Arguments of learning from recordings.
#[derive(Debug, Clone, clap::Args)]
pub struct RecordingArgs {
    /// Learn from a recorded bag (MCAP or sqlite3, file or folder; repeatable), without labels: pictures at other times
    /// than the context's have to come out as the cameras saw them. Wants --stage render. Depth and sky masks are used
    /// where the bag has them (/ground_truth/..., as `storm synth` writes); its flow and motion never are. Without sky
    /// masks there is no sky term: all that is said about opacity is that rays 10 degrees and more below the vehicle's
    /// horizontal meet the ground, the rest and the sky's colour have to follow from the pictures; starting from trained
    /// weights, or mixing drives in (--bag-share), keeps it from drifting.
    #[arg(long, value_name = "BAG", conflicts_with = "resume")]
    bag: Vec<PathBuf>,
    /// Share of the batches cut from bags; the others are procedural drives [default: 1 with --bag].
    #[arg(long, requires = "bag", allow_hyphen_values = true)]
    bag_share: Option<f64>,
    /// Learn from a bag's clips from here on, seconds after its first synchronized set.
    #[arg(long, requires = "bag", default_value_t = 0.0, allow_hyphen_values = true)]
    from_sec: f64,
    /// Use nothing later than this of a bag for learning [default: to the end]. What a range leaves out is scored: PSNR of
    /// held-out pictures in bags.csv.
    #[arg(long, requires = "bag", allow_hyphen_values = true)]
    to_sec: Option<f64>,
    /// Use only the first cameras of the bags' rigs [default: all; --cameras is the drives'].
    #[arg(long, requires = "bag")]
    bag_cameras: Option<usize>,
    /// Configuration file with the bags' topics and frames, as `storm replay --config` takes it.
    #[arg(long, requires = "bag", value_name = "FILE")]
    bag_config: Option<PathBuf>,
    /// Feature network of the perceptual term (weight 0.05, from --structure-from on): a safetensors file of a VGG-16,
    /// VGG-19 or AlexNet with torchvision's names (features.0.weight, features.0.bias, ...) and LPIPS's channel weights
    /// (lin0.model.1.weight, ...). Without one a multi-scale structure term stands in for LPIPS, and the weights' metadata
    /// says so.
    #[arg(long, value_name = "FILE", conflicts_with = "resume")]
    lpips: Option<PathBuf>,
}

/// Found again whatever the folder a resumed run starts in.
fn whole(path: &Path) -> Result<String> {
    let path = path.canonicalize().with_context(|| format!("cannot read {}", path.display()))?;
    Ok(path.to_string_lossy().into_owned())
}

impl RecordingArgs {
    /// Whether recordings are all there is to learn from.
    pub fn alone(&self) -> bool {
        !self.bag.is_empty() && self.bag_share.is_none_or(|share| share >= 1.0)
    }

    /// Into the options of a new run.
    pub fn apply(&self, options: &mut TrainOptions) -> Result<()> {
        if let Some(path) = &self.lpips {
            if options.stage == Stage::Pixel {
                return Err(UsageError("--lpips compares drawn pictures; use --stage render or both".into()).into());
            }
            options.features = Some(whole(path)?);
        }
        if self.bag.is_empty() {
            return Ok(());
        }
        options.recordings = Some(RecordingOptions {
            bags: self.bag.iter().map(|b| whole(b)).collect::<Result<_>>()?,
            share: self.bag_share.unwrap_or(1.0),
            from_sec: self.from_sec,
            to_sec: self.to_sec,
            cameras: self.bag_cameras,
            config: self.bag_config.as_deref().map(whole).transpose()?,
        });
        Ok(())
    }
}

/// The bags of a run, read.
pub struct Recordings {
    bags: Vec<Arc<BagClips>>,
    share: f64,
    /// One row per validation, where there is something to score.
    table: Option<Table>,
}

impl Recordings {
    /// Reads what the run's options name: bags, and the feature network (which the trainer gets).
    pub fn open(trainer: &mut Trainer, out: &Path, device: &Device) -> Result<Self> {
        if let Some(path) = trainer.options().features.clone() {
            trainer.set_features(&path, FeatureNetwork::load(Path::new(&path), device)?);
            info!("perceptual term: LPIPS with {path}");
        }
        let Some(options) = trainer.options().recordings.clone() else {
            return Ok(Self { bags: Vec::new(), share: 0.0, table: None });
        };
        let config = trainer.config();
        let bag_options = BagOptions {
            from_sec: options.from_sec,
            to_sec: options.to_sec.unwrap_or(f64::INFINITY),
            cameras: options.cameras,
            clips: ClipOptions { ..trainer.options().clips },
        };
        let size = (config.image_width, config.image_height);
        let bags = open_all(&options.bags, options.config.as_deref(), size, &bag_options)?;
        for bag in &bags {
            let most = config.num_cams;
            if config.use_affine_token && bag.cameras() > most {
                let (name, n) = (bag.name(), bag.cameras());
                let text = format!("bag {name} has {n} cameras, the network is for {most}; use --bag-cameras {most}");
                return Err(UsageError(text).into());
            }
            if trainer.options().stage == Stage::Pixel && !bag.has_depth() {
                let name = bag.name();
                let text = format!("bag {name} has no ground truth for --stage pixel; use --stage render");
                return Err(UsageError(text).into());
            }
        }
        let ranged = options.from_sec > 0.0 || options.to_sec.is_some();
        let table =
            ranged.then(|| Table::open(out.join("bags.csv"), &COLUMNS, trainer.steps_done() + 1)).transpose()?;
        Ok(Self { bags, share: options.share, table })
    }

    /// The batches of the run.
    pub fn data(&self, trainer: &Trainer) -> MixedData {
        let recordings = self.bags.iter().map(|bag| Arc::clone(bag) as Arc<dyn ClipSource>).collect();
        MixedData { drives: trainer.data(), recordings, share: self.share }
    }

    /// Scores a network on what the range leaves out of the bags.
    pub fn score(&mut self, model: &Storm, step: u64, device: &Device) -> Result<()> {
        let Some(table) = &mut self.table else { return Ok(()) };
        let mut clips = Vec::new();
        for bag in &self.bags {
            for clip in bag.outside(model.config()) {
                clips.push(clip?);
            }
        }
        if clips.is_empty() {
            warn!("the range leaves no whole clip out of the bags, so nothing is held out to score");
            self.table = None;
            return Ok(());
        }
        let held = held_pictures(model, &clips, device)?;
        let one = |x: Option<f64>| x.map_or("-".into(), |x| format!("{x:.2}"));
        say!(
            "step {step}: held-out part of the bags: PSNR {} dB (nearest context picture {} dB), {} pictures",
            one(held.psnr),
            one(held.psnr_nearest),
            held.pictures
        );
        table.push(step, vec![held.psnr, held.psnr_nearest, Some(held.pictures as f64)])
    }
}

const COLUMNS: [&str; 3] = ["psnr", "psnr_nearest", "pictures"];
