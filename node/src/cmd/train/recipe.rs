//! What a run does unless told otherwise: what makes weights like the ones that ship, or what the paper did.

use anyhow::Result;
use storm_model::train::{LookOptions, Optimizer, Stage, TrainOptions};

use crate::cmd::UsageError;

/// The paper's highest learning rate.
pub const PAPER_RATE: f64 = 4e-4;

/// How a run learns.
#[derive(Debug, Clone, clap::Args)]
pub struct RecipeArgs {
    /// Where the choices below come from when they are not given. small: what learns most on a small budget (one camera first,
    /// from the truth of every pixel; then all cameras, pictures drawn as well), in one run what the weights that ship got in several;
    /// paper: rendering losses alone, AdamW at 4e-4.
    #[arg(long, default_value = "small", value_parser = ["small", "paper"])]
    recipe: String,
    /// Highest learning rate [small: 1e-3 for a new network, 3e-4 for trained weights; paper: 4e-4].
    #[arg(long)]
    lr: Option<f64>,
    /// What moves the transformer's matrices: adamw, or muon, which learns more per sample on small budgets [small: muon,
    /// paper: adamw].
    #[arg(long, value_parser = ["adamw", "muon"])]
    optimizer: Option<String>,
    /// What to learn from. pixel: the truth of every context pixel (cheap); render: pictures drawn at other times, the
    /// paper's; both: their sum [small: both, with --bag render; paper: render].
    #[arg(long, value_parser = ["pixel", "render", "both"])]
    stage: Option<String>,
    /// First step of --stage both that draws pictures; before it only the pixels' truth is used [small: after
    /// --one-camera-steps].
    #[arg(long)]
    render_from: Option<u64>,
    /// Target times drawn per clip in the render stage, 1 to 10 [small: 2, paper: 4].
    #[arg(long)]
    targets: Option<usize>,
    /// Steps before the perceptual term of the render stage is switched on [small: two thirds of the run, paper: 5000].
    #[arg(long)]
    structure_from: Option<u64>,
    /// Steps with one camera before all are used [small: 55 % of the run of a new network, paper: 0].
    #[arg(long)]
    one_camera_steps: Option<u64>,
    /// Lenses of the drives' clips: own, or varied, with numbers of cameras that vary too, for weights that meet other rigs
    /// than the drives' [small: varied, paper: own].
    #[arg(long, value_parser = ["own", "varied"])]
    lenses: Option<String>,
    /// What of the look of the drives' clips varies from clip to clip: plain (nothing), varied (everything), or some of sensor, light,
    /// textures, solids, pull_out, rigs, poses with commas between them. Validation stays plain.
    #[arg(long, default_value = "plain", value_parser = LookOptions::parse)]
    looks: LookOptions,
    /// Strides that the anchor of half the drives' clips may lie before their first timestep, the clock beginning there, for
    /// weights that keep their accuracy where steps go on in an older frame (skip.reuse) [0: the paper's].
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=8))]
    anchor_lead: u32,
    /// How often each clip is shown, at least 1; driving a clip costs a quarter of learning from it [small: 2, paper: 1].
    #[arg(long)]
    reuse: Option<u64>,
}

/// What a run starts from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Start {
    /// Nothing is known yet.
    New,
    /// Trained weights.
    Weights,
    /// Trained or new weights, and only recordings to learn from.
    Recordings,
}

impl RecipeArgs {
    /// Into the options of a new run.
    pub fn apply(&self, options: &mut TrainOptions, start: Start) -> Result<(), UsageError> {
        let small = self.small();
        let steps = options.schedule.steps;
        options.schedule.peak = self.lr.unwrap_or(match (small, start) {
            (true, Start::New) => 1e-3,
            (true, _) => 3e-4,
            (false, _) => PAPER_RATE,
        });
        options.optimizer = match self.optimizer.as_deref() {
            Some("adamw") => Optimizer::AdamW,
            Some(_) => Optimizer::Muon,
            None if small => Optimizer::Muon,
            None => Optimizer::AdamW,
        };
        options.stage = match self.stage.as_deref() {
            Some("pixel") => Stage::Pixel,
            Some("both") => Stage::Both,
            Some(_) => Stage::Render,
            None if small && start != Start::Recordings => Stage::Both,
            None => Stage::Render,
        };
        let one_camera = if small && start == Start::New { steps * 55 / 100 } else { 0 };
        options.one_camera_steps = self.one_camera_steps.unwrap_or(one_camera);
        options.render_from = match (self.render_from, options.stage) {
            (Some(step), Stage::Both) => step,
            (Some(step), _) => return Err(UsageError(format!("--render-from {step} belongs to --stage both"))),
            (None, Stage::Both) if small => options.one_camera_steps,
            (None, _) => 0,
        };
        options.clips.targets = self.targets.unwrap_or(if small { 2 } else { 4 });
        let structure_from = if small { steps * 2 / 3 } else { 5000 };
        options.render.structure_from_step = self.structure_from.unwrap_or(structure_from);
        options.clips.variety = self.lenses.as_deref().map_or(small, |l| l == "varied");
        options.clips.looks = self.looks;
        options.clips.anchor_lead = self.anchor_lead;
        options.reuse = self.reuse.unwrap_or(if small { 2 } else { 1 });
        Ok(())
    }

    /// The recipe's name.
    pub fn name(&self) -> &str {
        &self.recipe
    }

    fn small(&self) -> bool {
        self.recipe == "small"
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        recipe: RecipeArgs,
    }

    fn options(line: &str, start: Start) -> TrainOptions {
        let recipe = Line::parse_from(std::iter::once("train").chain(line.split_whitespace())).recipe;
        let mut options = TrainOptions::new(0, 900, 8, PAPER_RATE);
        recipe.apply(&mut options, start).unwrap();
        options
    }

    #[test]
    fn a_new_network_begins_with_one_camera_and_draws_later() {
        let o = options("", Start::New);
        assert_eq!((o.stage, o.optimizer, o.schedule.peak), (Stage::Both, Optimizer::Muon, 1e-3));
        assert_eq!((o.one_camera_steps, o.render_from, o.render.structure_from_step), (495, 495, 600));
        assert_eq!((o.stage_at(494), o.stage_at(495)), (Stage::Pixel, Stage::Both));
        let o = options("--one-camera-steps 10", Start::New);
        assert_eq!(o.render_from, 10);
    }

    #[test]
    fn trained_weights_and_recordings_need_no_such_beginning() {
        let o = options("", Start::Weights);
        assert_eq!((o.one_camera_steps, o.render_from, o.stage), (0, 0, Stage::Both));
        assert_eq!(o.schedule.peak, 3e-4);
        assert_eq!(options("", Start::Recordings).stage, Stage::Render);
    }

    #[test]
    fn the_papers_choices_are_one_word_and_each_can_be_replaced() {
        let o = options("--recipe paper", Start::New);
        assert_eq!((o.stage, o.optimizer, o.schedule.peak), (Stage::Render, Optimizer::AdamW, 4e-4));
        assert_eq!((o.clips.targets, o.reuse, o.clips.variety, o.one_camera_steps), (4, 1, false, 0));
        let o = options("--recipe paper --optimizer muon --lenses varied --reuse 3", Start::New);
        assert_eq!((o.optimizer, o.clips.variety, o.reuse, o.stage), (Optimizer::Muon, true, 3, Stage::Render));
    }

    #[test]
    fn looks_are_plain_until_asked_for() {
        assert_eq!(options("", Start::New).clips.looks, LookOptions::default());
        assert_eq!(options("--looks varied", Start::New).clips.looks, LookOptions::varied());
        assert!(Line::try_parse_from(["train", "--looks", "wild"]).is_err());
    }

    #[test]
    fn a_later_beginning_of_drawing_wants_both_stages() {
        let recipe = Line::parse_from(["train", "--stage", "pixel", "--render-from", "5"]).recipe;
        assert!(recipe.apply(&mut TrainOptions::new(0, 9, 1, 1e-3), Start::New).is_err());
    }
}
