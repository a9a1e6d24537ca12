//! Everything that decides what a training run computes. Stored in checkpoints.

use serde::{Deserialize, Serialize};

use super::adamw::AdamOptions;
use super::clips::ClipOptions;
use super::error::TrainError;
use super::looks::LookOptions;
use super::losses::RenderLossOptions;
use super::muon::Optimizer;
use super::pixel::PixelLossOptions;
use super::schedule::Schedule;
use super::source::RecordingOptions;

/// What the network is taught by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// Every Gaussian against the truth of its own pixel; draws nothing.
    Pixel,
    /// The paper's: pictures drawn at other times against what the cameras saw.
    Render,
    /// Both sums together, the rendering losses from [`TrainOptions::render_from`] on.
    Both,
}

/// A training run. With the same options, configuration and first weights, two runs give the same bytes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainOptions {
    /// Where the first weights came from, for the metadata of the ones made.
    pub history: String,
    /// Chooses all samples.
    pub seed: u64,
    /// Samples per step.
    pub batch: usize,
    /// What is taught.
    pub stage: Stage,
    /// Learning rate.
    pub schedule: Schedule,
    /// What moves the blocks' matrices.
    #[serde(default)]
    pub optimizer: Optimizer,
    /// AdamW and clipping.
    pub adam: AdamOptions,
    /// Moving average of the weights: how much of it stays per step.
    pub average_decay: f64,
    /// Losses of [`Stage::Pixel`].
    pub pixel: PixelLossOptions,
    /// Losses on rendered target views.
    pub render: RenderLossOptions,
    /// Clips.
    pub clips: ClipOptions,
    /// Steps with one camera before all cameras are used.
    pub one_camera_steps: u64,
    /// First step of [`Stage::Both`] that draws; before it only the pixels' truth is used.
    #[serde(default)]
    pub render_from: u64,
    /// Recordings clips are cut from; none: procedural drives only.
    #[serde(default)]
    pub recordings: Option<RecordingOptions>,
    /// File of the feature network of the perceptual term; none: the structure term stands in for it.
    #[serde(default)]
    pub features: Option<String>,
    /// How many times each clip is shown.
    #[serde(default = "once")]
    pub reuse: u64,
}

fn once() -> u64 {
    1
}

impl TrainOptions {
    /// What step `step` learns from.
    pub fn stage_at(&self, step: u64) -> Stage {
        if self.stage == Stage::Both && step < self.render_from { Stage::Pixel } else { self.stage }
    }

    /// Options for `steps` steps of `batch` samples with everything else usual.
    pub fn new(seed: u64, steps: u64, batch: usize, peak: f64) -> Self {
        let warmup_steps = (steps / 20).min(5000);
        Self {
            history: "unknown weights".into(),
            seed,
            batch,
            stage: Stage::Pixel,
            schedule: Schedule { peak, warmup_steps, steps, end_share: 0.01 },
            optimizer: Optimizer::AdamW,
            adam: AdamOptions::default(),
            average_decay: 0.999,
            pixel: PixelLossOptions::default(),
            render: RenderLossOptions::default(),
            clips: ClipOptions::default(),
            one_camera_steps: 0,
            render_from: 0,
            recordings: None,
            features: None,
            reuse: 1,
        }
    }

    /// Refuses what cannot be trained with.
    pub fn check(&self) -> Result<(), TrainError> {
        let rule = |ok: bool, name, value: f64, allowed| {
            if ok { Ok(()) } else { Err(TrainError::Option { name, value: value.to_string(), allowed }) }
        };
        let unit = 0.0..1.0;
        self.recordings.as_ref().map_or(Ok(()), RecordingOptions::check)?;
        rule((1..=4096).contains(&self.batch), "batch", self.batch as f64, "1 to 4096")?;
        if self.stage != Stage::Pixel {
            rule((1..=10).contains(&self.clips.targets), "targets", self.clips.targets as f64, "1 to 10")?;
        }
        let peak = self.schedule.peak;
        rule(peak > 0.0 && peak <= 1.0, "lr", peak, "more than 0, at most 1")?;
        rule((1..=1000).contains(&self.reuse), "reuse", self.reuse as f64, "1 to 1000")?;
        rule(self.schedule.steps > 0, "steps", 0.0, "at least 1")?;
        rule(unit.contains(&self.average_decay), "average_decay", self.average_decay, "0 to below 1")?;
        let a = &self.adam;
        rule(unit.contains(&a.beta1), "beta1", a.beta1, "0 to below 1")?;
        rule(unit.contains(&a.beta2), "beta2", a.beta2, "0 to below 1")?;
        rule(a.basis_rate > 0.0 && a.basis_rate <= 100.0, "basis_rate", a.basis_rate, "more than 0, at most 100")?;
        rule(a.eps > 0.0, "eps", a.eps, "more than 0")?;
        let p = &self.pixel;
        let weights = [
            ("log_depth", p.log_depth),
            ("depth", p.depth),
            ("swept_depth", p.swept_depth),
            ("color", p.color),
            ("opacity", p.opacity),
            ("scale", p.scale),
            ("sky_color", p.sky_color),
            ("velocity", p.velocity),
            ("flow", p.flow),
            ("groups", p.groups),
            ("bases", p.bases),
            ("render depth", self.render.depth),
            ("sky_opacity", self.render.sky_opacity),
            ("render velocity", self.render.velocity),
            ("structure", self.render.structure),
            ("weight_decay", a.weight_decay),
            ("clip_norm", a.clip_norm),
        ];
        for (name, x) in weights {
            rule(x >= 0.0 && x.is_finite(), name, x, "0 or a positive number")?;
        }
        rule(p.moving_weight >= 1.0, "moving_weight", p.moving_weight, "at least 1")?;
        rule(p.footprint_px > 0.0, "footprint_px", p.footprint_px, "more than 0")
    }

    /// What the perceptual term of the render stage is computed with, where there is one.
    fn perceptual(&self) -> Option<String> {
        let RenderLossOptions { structure, structure_from_step: from, .. } = self.render;
        if self.stage == Stage::Pixel || structure == 0.0 || from >= self.schedule.steps {
            return None;
        }
        let kind = match &self.features {
            Some(path) => {
                let name = std::path::Path::new(path).file_name();
                format!("LPIPS with {}", name.map_or_else(|| "a feature network".into(), |n| n.to_string_lossy()))
            }
            None => "structure term standing in for LPIPS".to_owned(),
        };
        Some(format!("{kind} from step {from}"))
    }

    /// One line on what weights trained so have seen, for their metadata.
    pub fn describe(&self) -> String {
        format!("{}; {}", self.history, self.describe_run())
    }

    /// The same of this run alone, without what the weights were before.
    pub fn describe_run(&self) -> String {
        let mut labels = Vec::new();
        if self.stage != Stage::Render {
            let flow = if self.pixel.flow > 0.0 { "with ground-truth flow labels" } else { "no flow labels" };
            let depth = if self.pixel.log_depth + self.pixel.depth > 0.0 { "depth, " } else { "" };
            labels.push(format!("pixel stage ({depth}sky and colour labels, {flow})"));
        }
        if self.stage != Stage::Pixel {
            let depth = if self.render.depth > 0.0 { "depth and sky labels" } else { "sky labels" };
            let from = match (self.stage, self.render_from) {
                (Stage::Both, from @ 1..) => format!(", from step {from} on"),
                _ => String::new(),
            };
            labels.push(format!("render stage ({depth}, no flow labels{from})"));
        }
        labels.extend(self.perceptual());
        labels.extend(self.recordings.as_ref().map(RecordingOptions::describe));
        let labels = labels.join(" + ");
        let c = &self.clips;
        format!(
            "{labels}; procedural drives of data seed {}, {} cameras x {} timesteps of {}x{} (first {} steps one camera), each clip shown {} times{}{}{}; batch {}, {}, peak rate {:e}, schedule of {} steps",
            self.seed,
            c.cameras,
            c.timesteps,
            c.width,
            c.height,
            self.one_camera_steps,
            self.reuse,
            if c.variety { ", varied lenses and numbers of cameras" } else { "" },
            match c.anchor_lead {
                0 => String::new(),
                n => format!(", anchors up to {n} strides early"),
            },
            if c.looks == LookOptions::default() { String::new() } else { format!(", looks {}", c.looks.describe()) },
            self.batch,
            match self.optimizer {
                Optimizer::AdamW => "AdamW",
                Optimizer::Muon => "Muon and AdamW",
            },
            self.schedule.peak,
            self.schedule.steps,
        )
    }
}
