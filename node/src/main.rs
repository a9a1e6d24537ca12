//! The program `storm`. Parses the command line, runs one command, and turns its outcome into an exit code.

use std::process::ExitCode;

use clap::Parser;
use storm_node::cmd::{Cli, Outcome};

fn main() -> ExitCode {
    storm_model::ops::share_one_heap();
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(e) => {
            // Help and version are answers, not errors. clap would exit with 2, which here means unreadable input.
            let _ = e.print();
            return ExitCode::from(if e.use_stderr() { Outcome::Usage.code() } else { Outcome::Done.code() });
        }
    };
    ExitCode::from(cli.run().code())
}
