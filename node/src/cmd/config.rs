//! `storm config`: the documented defaults.

use anyhow::Result;

use super::Outcome;
use crate::config::Config;

/// Arguments of `storm config`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Print the Markdown table of the README instead of YAML.
    #[arg(long)]
    markdown: bool,
}

/// Prints the defaults.
pub fn run(args: &Args) -> Result<Outcome> {
    say_text!("{}", if args.markdown { Config::markdown() } else { Config::documented_yaml() });
    Ok(Outcome::Done)
}
