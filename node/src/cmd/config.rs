//! `storm config`: the documented defaults.

use std::io::{ErrorKind, Write};

use anyhow::{Context, Result};

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
    let text = if args.markdown { Config::markdown() } else { Config::documented_yaml() };
    let mut out = std::io::stdout();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        // Mostly redirected into a file: half a configuration is no configuration. A reader who has seen enough is no loss.
        Err(e) if e.kind() != ErrorKind::BrokenPipe => Err(e).context("the configuration cannot be written"),
        _ => Ok(Outcome::Done),
    }
}
