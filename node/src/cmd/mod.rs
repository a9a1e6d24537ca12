//! The commands of the program `storm`: each file parses its own arguments and calls the library.

#[macro_use]
mod say;

mod bench;
mod config;
mod demo;
mod eval;
mod info;
mod interrupt;
mod map;
mod node;
mod refine;
mod render;
mod replay;
mod soak;
mod stress;
mod synth;
mod train;

use std::io::IsTerminal;

use clap::{Parser, Subcommand};
use tracing_subscriber::EnvFilter;

use crate::config::ConfigError;
use crate::error_line::error_line;
use crate::source::RigError;

/// How a command ended; the exit codes are part of the program's contract.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// Done, nothing lost.
    Done,
    /// Bad usage or configuration.
    Usage,
    /// Input cannot be read.
    Input,
    /// Finished, but something was lost; what was it is on stderr and in metrics.json.
    Lost,
}

impl Outcome {
    /// The process exit code.
    pub fn code(self) -> u8 {
        match self {
            Self::Done => 0,
            Self::Usage => 1,
            Self::Input => 2,
            Self::Lost => 3,
        }
    }
}

/// Bad usage found after the command line was parsed (a value that does not fit, a place that cannot be written).
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(pub String);

/// Streaming STORM: posed camera images in; 3D Gaussians, scene flow, motion masks, a map and trajectories out.
#[derive(Debug, Parser)]
#[command(name = "storm", version = env!("STORM_VERSION"), arg_required_else_help = true)]
#[command(
    after_help = "Exit codes: 0 done; 1 bad usage or configuration; 2 input cannot be read; 3 finished, but something was lost.\n\
Results go to stdout, logs to stderr. RUST_LOG=debug shows more."
)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
    /// Log only errors, and show no progress bar.
    #[arg(long, short, global = true)]
    quiet: bool,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Make a short drive and reconstruct it: needs no data, ends in a results folder with a report.
    Demo(demo::Args),
    /// Reconstruct a recorded bag (MCAP or sqlite3, file or folder) into a results folder.
    Replay(replay::Args),
    /// Run live under ROS 2: topics in, topics out.
    Node(node::Args),
    /// Write a procedural drive as a bag, ground truth included.
    Synth(synth::Args),
    /// Draw a saved map or step from any pose at any time.
    Render(render::Args),
    /// Check a saved map, say what it holds, write it as PLY.
    Map(map::Args),
    /// Sharpen a saved map by per-scene optimisation on a bag's pictures.
    Refine(refine::Args),
    /// Say what a bag holds and how it would be used.
    Info(info::Args),
    /// Error figures on procedural drives that training never sees, beside simple baselines.
    Eval(eval::Args),
    /// Make weights: train a network on procedural drives.
    Train(Box<train::Args>),
    /// Measure run time: the network at full size, the rasteriser, the drive, and the settings of a step.
    Bench(bench::Args),
    /// Long procedural drives through the map and the trackers, without a network: times, memory, errors.
    Soak(soak::Args),
    /// Put numbers at their limits through the engine and compare with f64: a table of what was tried and what came out.
    Stress(stress::Args),
    /// Print every configuration key with its default and meaning, as a YAML file ready to edit.
    Config(config::Args),
}

impl Cli {
    /// Runs the command; errors are printed as one line on stderr.
    pub fn run(self) -> Outcome {
        start_log(self.quiet);
        if let Err(e) = storm_model::kernels::Isa::asked_for() {
            complain!("error: {e}");
            return Outcome::Usage;
        }
        let progress = !self.quiet && std::io::stderr().is_terminal();
        let result = match self.command {
            Command::Demo(a) => demo::run(&a, progress),
            Command::Replay(a) => replay::run(&a, progress),
            Command::Node(a) => node::run(&a),
            Command::Synth(a) => synth::run(&a, progress),
            Command::Render(a) => render::run(&a),
            Command::Map(a) => map::run(&a),
            Command::Refine(a) => refine::run(&a, progress),
            Command::Info(a) => info::run(&a),
            Command::Eval(a) => eval::run(&a, progress),
            Command::Train(a) => train::run(&a, progress),
            Command::Bench(a) => bench::run(&a, progress),
            Command::Soak(a) => soak::run(&a, progress),
            Command::Stress(a) => stress::run(&a, progress),
            Command::Config(a) => config::run(&a),
        };
        result.unwrap_or_else(|e| {
            complain!("error: {}", error_line(&e));
            let of_masks = |c: &(dyn std::error::Error + 'static)| matches!(c.downcast_ref(), Some(RigError::Mask(_)));
            let usage = e.chain().any(|c| c.is::<ConfigError>() || c.is::<UsageError>() || of_masks(c));
            if usage { Outcome::Usage } else { Outcome::Input }
        })
    }
}

/// WIDTHxHEIGHT, both above 0.
fn parse_size(name: &str, text: &str) -> Result<(usize, usize), UsageError> {
    let number = |part: &str| part.parse().ok().filter(|n| *n > 0);
    let both = text.split_once('x').and_then(|(w, h)| Some((number(w)?, number(h)?)));
    both.ok_or_else(|| UsageError(format!("{name} '{text}' is not WIDTHxHEIGHT")))
}

fn start_log(quiet: bool) {
    let default = if quiet { "error" } else { "info" };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(default));
    // A second call (tests) keeps the first subscriber.
    let _ = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .with_target(false)
        .without_time()
        // Said by a macro that panics when the standard error cannot be written to.
        .log_internal_errors(false)
        .try_init();
}

/// A progress bar with rate and time left; hidden when stderr is not a terminal.
pub(crate) fn progress_bar(visible: bool, total: u64, what: &'static str) -> indicatif::ProgressBar {
    if !visible {
        return indicatif::ProgressBar::hidden();
    }
    let style = indicatif::ProgressStyle::with_template("{msg} [{bar:40}] {pos}/{len} ({per_sec}, {eta} left)")
        .unwrap_or_else(|_| indicatif::ProgressStyle::default_bar());
    indicatif::ProgressBar::new(total).with_style(style).with_message(what)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_well_formed() {
        use clap::CommandFactory;
        Cli::command().debug_assert();
    }
}
