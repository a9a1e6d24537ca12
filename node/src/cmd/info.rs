//! `storm info`: what a bag holds, how it would be used, and whether a replay of it would do well. Runs the checks a replay runs,
//! and ends with the exit code that one would end with, as far as stamps and each camera's first images say.

use std::collections::VecDeque;
use std::path::PathBuf;

use anyhow::{Context, Result};

use super::Outcome;
use super::replay::Overrides;
use crate::bag::Bag;
use crate::cdr::decode as cdr;
use crate::config::Config;
use crate::engine::ModelSource;
use crate::pipeline::front::{Front, FrontOutput};
use crate::pipeline::posed::{PoseStore, seconds};
use crate::source::bag::{BagSource, plan_of};
use crate::source::survey::{Stamps, Survey};
use crate::source::topics::CameraTopics;
use crate::sync::{DropCounts, DropReason};

/// Arguments of `storm info`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// MCAP or sqlite3 bag, file or folder.
    bag: PathBuf,
    #[command(flatten)]
    overrides: Overrides,
}

/// Prints the topics, the parts they would play, and what a replay would make of them.
pub fn run(args: &Args) -> Result<Outcome> {
    let config = args.overrides.config()?;
    let bag = Bag::open(&args.bag).with_context(|| format!("cannot read bag {}", args.bag.display()))?;
    let recorded_sec = match (bag.start_ns(), bag.end_ns()) {
        (Some(start), Some(end)) => (end as f64 - start as f64) * 1e-9,
        _ => 0.0,
    };
    say!("{}: {} messages over {recorded_sec:.2} s", args.bag.display(), bag.message_count());
    for t in bag.topics() {
        say!("  {:>7}  {}  {} ({})", t.count, t.name, t.type_name, t.serialization);
    }
    bag.problems().iter().for_each(|p| say!("problem: {p}"));
    let plan = plan_of(&bag, &config.input).with_context(|| format!("bag {}", args.bag.display()))?;
    let survey = Survey::whole(&bag, &plan)?;
    for (i, (c, stamps)) in plan.cameras.iter().zip(&survey.cameras).enumerate() {
        say!("camera {i}: {} with {}: {}", c.name, bag.topics()[c.info].name, first_image(&bag, c)?);
        say!("  {}", rate(stamps));
    }
    for left_out in &plan.left_out {
        say!("no camera: {left_out}");
    }
    for (name, stamps) in &survey.poses {
        say!("  {name}: {}", rate(stamps));
    }
    say!("ground truth: {} topics", plan.truth.len());
    let model = ModelSource::open(&config.model)?;
    let size = model.picture_size(&config.model)?;
    let source = BagSource::open(&args.bag, &config, size)?;
    let rig = source.rig();
    rig.lines(size).iter().for_each(|line| say!("{line}"));
    say!("{}", source.pose_line());
    rig.warnings().iter().for_each(|line| say!("warning: {line}"));
    source.check().with_context(|| format!("bag {}", args.bag.display()))?;
    expect(&source, &config)
}

/// Size and encoding of a camera's first image.
fn first_image(bag: &Bag, camera: &CameraTopics) -> Result<String> {
    let Some(message) = bag.messages(&[camera.image])?.flatten().next() else { return Ok("no image".into()) };
    Ok(match camera.compressed {
        true => {
            cdr::compressed_image(&message.data).map_or_else(|e| e.to_string(), |m| format!("format `{}`", m.format))
        }
        false => cdr::image(&message.data)
            .map_or_else(|e| e.to_string(), |m| format!("{}x{} {}", m.width, m.height, m.encoding)),
    })
}

fn rate(stamps: &Stamps) -> String {
    if stamps.count == 0 {
        return format!("no readable message, {} unreadable", stamps.unreadable);
    }
    let first_sec = stamps.first_ns as f64 * 1e-9;
    let mut text =
        format!("{} messages, stamped {first_sec:.3} to {:.3} s", stamps.count, stamps.last_ns as f64 * 1e-9);
    if let Some(interval_sec) = stamps.interval_sec().filter(|&sec| sec > 0.0) {
        text += &format!(", {:.1} Hz, largest gap {} s", 1.0 / interval_sec, seconds(stamps.gap_sec));
    }
    if stamps.unreadable > 0 {
        text += &format!(", {} unreadable", stamps.unreadable);
    }
    text
}

/// Runs the stamps through synchronisation, poses and windows, and says what comes out.
fn expect(source: &BagSource, config: &Config) -> Result<Outcome> {
    let rig = source.rig();
    let mut front = Front::new(config, &rig, PoseStore::of_bag(source, &rig, config));
    let (mut ready, mut sets, mut windows) = (VecDeque::new(), 0u64, 0u64);
    let mut count = |ready: &mut VecDeque<FrontOutput>| {
        for output in ready.drain(..) {
            match output {
                FrontOutput::Set(_) => sets += 1,
                FrontOutput::Window(_) => windows += 1,
                FrontOutput::Truth { .. } => {}
            }
        }
    };
    source.events_without_pixels(|event| {
        front.take(event, &mut ready);
        count(&mut ready);
        true
    })?;
    front.finish(&mut ready);
    count(&mut ready);
    let drops = front.drops();
    let without: u64 = [DropReason::NoPose, DropReason::PoseGap, DropReason::Edge].iter().map(|&r| drops.get(r)).sum();
    say!("poses cover {} of {} images", front.images_in().saturating_sub(without), front.images_in());
    say!("to expect: {sets} sets of images with poses, {windows} windows ({})", describe(&drops));
    if let Some(verdict) = front.verdict() {
        complain!("{verdict}");
    }
    let mut lost = drops.lost() > 0 || front.messages_lost() > 0 || front.poses_rejected() > 0;
    if windows == 0 {
        lost = true;
        complain!(
            "no step would be run: a window needs {} timesteps {} s apart, {} s in all (window.timesteps, window.stride_sec)",
            config.window.timesteps,
            config.window.stride_sec,
            seconds(config.window.span_sec())
        );
    }
    Ok(if lost || !source.problems().is_empty() { Outcome::Lost } else { Outcome::Done })
}

fn describe(drops: &DropCounts) -> String {
    if drops.total() == 0 { "no image is dropped".into() } else { format!("images not used: {drops}") }
}
