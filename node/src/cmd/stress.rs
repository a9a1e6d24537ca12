//! `storm stress`: numbers at their limits, as a table and JSON.

use std::path::PathBuf;

use anyhow::{Context, Result};
use serde_json::json;

use super::{Outcome, progress_bar};
use crate::stress::{CASES, Case, Size, run as stress};

/// Arguments of `storm stress`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// One camera, two timesteps, small pictures: what the tests run.
    #[arg(long)]
    quick: bool,
    /// Write the cases as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
    /// Write the table as Markdown.
    #[arg(long)]
    markdown: Option<PathBuf>,
}

/// Runs every case. Ends as lost (3) when one fails.
pub fn run(args: &Args, progress: bool) -> Result<Outcome> {
    let bar = progress_bar(progress, CASES, "stress");
    let mut cases = Vec::new();
    stress(if args.quick { Size::Reduced } else { Size::Full }, &mut |case| {
        bar.set_message(case.name.clone());
        bar.inc(1);
        cases.push(case);
    })?;
    bar.finish_and_clear();
    let failed: Vec<&Case> = cases.iter().filter(|c| !c.passed()).collect();
    let nonfinite: u64 = cases.iter().map(|c| c.nonfinite).sum();
    let table = table(&cases);
    say_text!("{table}");
    say!("{} cases, {} failed, {nonfinite} non-finite values", cases.len(), failed.len());
    if let Some(path) = &args.markdown {
        std::fs::write(path, &table).with_context(|| format!("cannot write {}", path.display()))?;
    }
    if let Some(path) = &args.json {
        let report = json!({"cases": cases, "failed": failed.len(), "nonfinite": nonfinite});
        std::fs::write(path, serde_json::to_string_pretty(&report)? + "\n")
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    for case in &failed {
        complain!("failed: {}: {}: {case:?}", case.group, case.name);
    }
    Ok(if failed.is_empty() { Outcome::Done } else { Outcome::Lost })
}

fn table(cases: &[Case]) -> String {
    let mut text =
        String::from("| part | case | worst error | limit | measured against | result |\n|---|---|---|---|---|---|\n");
    for case in cases {
        let result = match (case.passed(), &case.refused) {
            (false, _) => "FAILED".to_owned(),
            (true, Some(why)) => format!("refused: {}", why.replace('|', "/")),
            (true, None) => "ok".to_owned(),
        };
        let (error, limit) = match case.refused {
            Some(_) => ("-".to_owned(), "-".to_owned()),
            None => (format!("{:.1e}", case.worst_error), format!("{:.0e}", case.limit)),
        };
        text += &format!("| {} | {} | {error} | {limit} | {} | {result} |\n", case.group, case.name, case.against);
    }
    text
}
