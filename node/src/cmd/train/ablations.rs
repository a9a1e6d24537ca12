//! `storm train --ablations`: the grid of the paper's ablations (appendix, figures 8 and 9) at a small budget.
//!
//! Every network of the grid is trained with the command's own options and the same data, then scored on validation
//! drives, which no training sees. Finished networks are kept and not trained again by the next call, so a grid may be
//! made in pieces. A network whose training ended in a non-finite value is reported so: the paper saw that without the
//! velocity regulariser.

use std::collections::BTreeMap;
use std::sync::atomic::Ordering;
use std::time::Instant;

use anyhow::{Context, Result};
use candle_core::Device;
use serde_json::json;
use storm_model::Storm;
use storm_model::train::{ClipOptions, Loader, TrainError, Validation, validate};
use tracing::info;

use super::{Args, VALIDATION_TARGETS, save, start};
use crate::cmd::{Outcome, UsageError, interrupt, progress_bar};
use crate::output::atomic::write_bytes;

/// The default network of the grid: the paper's.
const BASE: Setting =
    Setting { lambda_reg: 0.005, motion_tokens: 16, timesteps: 4, sky_token: true, affine_token: true };

/// How a network of the grid is made.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Setting {
    lambda_reg: f64,
    motion_tokens: usize,
    timesteps: usize,
    sky_token: bool,
    affine_token: bool,
}

impl Setting {
    /// Folder of its files.
    fn folder(&self) -> String {
        let token = |on: bool, name: &str| if on { String::new() } else { format!("-no-{name}") };
        format!(
            "lambda{:e}-m{}-t{}{}{}",
            self.lambda_reg,
            self.motion_tokens,
            self.timesteps,
            token(self.sky_token, "sky"),
            token(self.affine_token, "affine")
        )
    }

    /// The command's arguments with this setting's.
    fn args(&self, common: &Args) -> Args {
        let mut args = common.clone();
        args.lambda_reg = Some(self.lambda_reg);
        args.variant.motion_tokens = Some(self.motion_tokens);
        args.variant.timesteps = Some(self.timesteps);
        (args.variant.no_sky_token, args.variant.no_affine_token) = (!self.sky_token, !self.affine_token);
        args.out = common.out.join(self.folder());
        args
    }
}

/// One row of the table: a network, seen with so many timesteps.
#[derive(Debug, Clone)]
struct Row {
    group: &'static str,
    label: String,
    setting: Setting,
    /// Timesteps of the clips it is scored on.
    seen: usize,
}

/// The grid.
fn grid() -> Vec<Row> {
    let mut rows = Vec::new();
    let mut add = |group: &'static str, label: String, setting: Setting, seen: usize| {
        rows.push(Row { group, label, setting, seen });
    };
    for lambda_reg in [0.0, 5e-4, 5e-3, 5e-2] {
        add("Velocity regulariser", format!("{lambda_reg}"), Setting { lambda_reg, ..BASE }, BASE.timesteps);
    }
    for motion_tokens in [0, 4, 8, 16, 32] {
        add("Motion tokens", motion_tokens.to_string(), Setting { motion_tokens, ..BASE }, BASE.timesteps);
    }
    for seen in [1, 2, 4, 6] {
        add("Timesteps, trained with 4", seen.to_string(), BASE, seen);
    }
    for timesteps in [1, 2, 4, 6] {
        add("Timesteps, retrained", timesteps.to_string(), Setting { timesteps, ..BASE }, timesteps);
    }
    for (sky_token, affine_token) in [(true, true), (false, true), (true, false), (false, false)] {
        let label = match (sky_token, affine_token) {
            (true, true) => "sky and affine",
            (false, true) => "no sky",
            (true, false) => "no affine",
            (false, false) => "neither",
        };
        add("Tokens", label.into(), Setting { sky_token, affine_token, ..BASE }, BASE.timesteps);
    }
    rows
}

/// What came of a network on clips of so many timesteps.
#[derive(Debug, Clone)]
enum Found {
    Figures(Validation),
    /// The training ended; why.
    Ended(String),
}

/// Trains and scores the grid.
pub fn run(args: &Args, device: &Device, progress: bool) -> Result<Outcome> {
    if args.validate_drives == 0 {
        return Err(UsageError("--ablations scores networks; use --validate-drives 1 or more".into()).into());
    }
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot make folder {}", args.out.display()))?;
    let rows = grid();
    let mut settings: Vec<Setting> = Vec::new();
    for row in &rows {
        if !settings.contains(&row.setting) {
            settings.push(row.setting);
        }
    }
    let stop = interrupt::stop_flag();
    let bar = progress_bar(progress, settings.len() as u64, "training networks");
    let mut found: BTreeMap<(String, usize), Found> = BTreeMap::new();
    for setting in &settings {
        let own = setting.args(args);
        let begin = Instant::now();
        let ended = train(&own, device, &stop)?;
        if stop.load(Ordering::Relaxed) {
            info!("stopped; the same command goes on with {}", setting.folder());
            return Ok(Outcome::Done);
        }
        for row in rows.iter().filter(|row| row.setting == *setting) {
            let key = (setting.folder(), row.seen);
            if found.contains_key(&key) {
                continue;
            }
            let result = match &ended {
                Some(why) => Found::Ended(why.clone()),
                None => Found::Figures(score(&own, row.seen, device)?),
            };
            found.insert(key, result);
        }
        info!("{}: {:.0} s", setting.folder(), begin.elapsed().as_secs_f64());
        bar.inc(1);
    }
    bar.finish_and_clear();
    let results: Vec<(Row, Found)> = rows
        .into_iter()
        .filter_map(|row| {
            let result = found.get(&(row.setting.folder(), row.seen))?.clone();
            Some((row, result))
        })
        .collect();
    write(args, &results)?;
    print!("{}", table(args, &results));
    println!("{}", args.out.join("ablations.md").display());
    Ok(Outcome::Done)
}

/// Trains one network unless its weights are there; a text where a non-finite value ended it.
fn train(args: &Args, device: &Device, stop: &std::sync::atomic::AtomicBool) -> Result<Option<String>> {
    let ended = args.out.join("ended.txt");
    if let Ok(why) = std::fs::read_to_string(&ended) {
        return Ok(Some(why.trim_end().to_owned()));
    }
    if args.out.join("weights.safetensors").exists() {
        return Ok(None);
    }
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot make folder {}", args.out.display()))?;
    let mut trainer = start(args, device)?;
    let mut loader = Loader::new(trainer.data(), trainer.config().clone(), 0, args.loader_threads);
    while trainer.steps_done() < trainer.options().schedule.steps {
        if stop.load(Ordering::Relaxed) {
            return Ok(None);
        }
        match trainer.step(&loader.next_batch()?) {
            Ok(_) => {}
            Err(e @ TrainError::NonFinite { .. }) => {
                let why = e.to_string();
                write_bytes(&ended, (why.clone() + "\n").as_bytes())?;
                return Ok(Some(why));
            }
            Err(e) => return Err(e.into()),
        }
    }
    save(args, &trainer)?;
    Ok(None)
}

fn score(args: &Args, timesteps: usize, device: &Device) -> Result<Validation> {
    let model = Storm::load(&args.out.join("weights.safetensors"), device)?;
    let config = model.config();
    let options = ClipOptions {
        cameras: args.cameras,
        width: config.image_width,
        height: config.image_height,
        timesteps,
        targets: VALIDATION_TARGETS,
        ..ClipOptions::default()
    };
    Ok(validate(&model, &options, args.validate_drives, device)?)
}

/// Name, digits after the point, and value of the figures of the table.
fn figures(v: &Validation) -> [(&'static str, usize, Option<f64>); 5] {
    [
        ("PSNR, dB", 2, v.psnr),
        ("depth error", 3, v.depth_relative),
        ("depth RMSE, m", 2, v.depth_rmse),
        ("EPE3D, m/s", 3, v.epe3d),
        ("EPE3D of movers, m/s", 3, v.epe3d_moving),
    ]
}

fn empty() -> Validation {
    Validation {
        depth_relative: None,
        depth_rmse: None,
        epe3d: None,
        epe3d_moving: None,
        epe3d_moving_still: None,
        psnr: None,
        opacity_surface: None,
        opacity_sky: None,
    }
}

fn table(args: &Args, results: &[(Row, Found)]) -> String {
    let names = figures(&empty()).map(|(name, _, _)| name);
    let mut text = format!(
        "# Ablations\n\n{} steps of {} clips, recipe {}, data seed {}; {} validation drives.\n\n| | | {} |\n|---|---|{}\n",
        args.steps,
        args.batch,
        args.recipe.name(),
        args.seed,
        args.validate_drives,
        names.join(" | "),
        "---|".repeat(names.len())
    );
    for (row, found) in results {
        let cells: Vec<String> = match found {
            Found::Figures(v) => {
                figures(v).iter().map(|(_, digits, x)| x.map_or("-".into(), |x| format!("{x:.digits$}"))).collect()
            }
            Found::Ended(why) => vec![why.clone(), "".into(), "".into(), "".into(), "".into()],
        };
        text += &format!("| {} | {} | {} |\n", row.group, row.label, cells.join(" | "));
    }
    text
}

fn write(args: &Args, results: &[(Row, Found)]) -> Result<()> {
    let one = |(row, found): &(Row, Found)| {
        let (figures, ended) = match found {
            Found::Figures(v) => (json!(v), json!(null)),
            Found::Ended(why) => (json!(null), json!(why)),
        };
        json!({"group": row.group, "setting": row.label, "timesteps_seen": row.seen, "figures": figures, "ended": ended})
    };
    let report = json!({
        "steps": args.steps,
        "batch": args.batch,
        "recipe": args.recipe.name(),
        "seed": args.seed,
        "validation_drives": args.validate_drives,
        "rows": results.iter().map(one).collect::<Vec<_>>(),
    });
    let put = |name: &str, text: String| write_bytes(&args.out.join(name), text.as_bytes());
    put("ablations.json", serde_json::to_string_pretty(&report)? + "\n")?;
    put("ablations.md", table(args, results))?;
    put("ablations.svg", picture(results))?;
    Ok(())
}

/// Sizes in SVG units.
const ROW: f64 = 18.0;
const HEAD: f64 = 26.0;
const LABEL: f64 = 190.0;
const BAR: f64 = 240.0;
const GAP: f64 = 90.0;

/// The figures drawn: their place in [`figures`] and colour.
const DRAWN: [(usize, &str); 2] = [(0, "#1f77b4"), (4, "#d95f02")];

/// Bars of every row, one column per figure drawn.
fn picture(results: &[(Row, Found)]) -> String {
    let value = |found: &Found, k: usize| match found {
        Found::Figures(v) => figures(v)[k].2.filter(|x| x.is_finite()),
        Found::Ended(_) => None,
    };
    let (mut y, mut group, mut body) = (HEAD, "", String::new());
    for (column, (k, _)) in DRAWN.iter().enumerate() {
        let x = LABEL + column as f64 * (BAR + GAP);
        let name = figures(&empty())[*k].0;
        body += &format!("<text x=\"{x}\" y=\"16\" font-weight=\"bold\">{name}</text>\n");
    }
    for (row, found) in results {
        if row.group != group {
            group = row.group;
            y += ROW;
            body += &format!("<text x=\"6\" y=\"{y:.0}\" font-weight=\"bold\">{group}</text>\n");
        }
        y += ROW;
        body += &format!("<text x=\"{}\" y=\"{y:.0}\" text-anchor=\"end\">{}</text>\n", LABEL - 8.0, row.label);
        for (column, (k, color)) in DRAWN.iter().enumerate() {
            let most = results.iter().filter_map(|(_, f)| value(f, *k)).fold(0.0, f64::max);
            let x = LABEL + column as f64 * (BAR + GAP);
            match value(found, *k) {
                Some(found) if most > 0.0 => {
                    let width = BAR * (found / most).max(0.0);
                    body += &format!(
                        "<rect x=\"{x}\" y=\"{:.0}\" width=\"{width:.1}\" height=\"12\" fill=\"{color}\"/>\n<text x=\"{:.1}\" y=\"{y:.0}\">{found:.2}</text>\n",
                        y - 10.0,
                        x + width + 5.0
                    );
                }
                _ => body += &format!("<text x=\"{x}\" y=\"{y:.0}\" fill=\"#b22222\">ended, not finite</text>\n"),
            }
        }
    }
    let (width, height) = (LABEL + DRAWN.len() as f64 * (BAR + GAP), y + HEAD);
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" font-family=\"sans-serif\" font-size=\"12\">\n\
         <rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n{body}</svg>\n"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_grid_is_the_papers_and_its_folders_are_apart() {
        let rows = grid();
        let mut settings: Vec<Setting> = Vec::new();
        rows.iter().for_each(|r| {
            if !settings.contains(&r.setting) {
                settings.push(r.setting);
            }
        });
        assert_eq!((rows.len(), settings.len()), (21, 14));
        let mut folders: Vec<String> = settings.iter().map(Setting::folder).collect();
        folders.sort_unstable();
        folders.dedup();
        assert_eq!(folders.len(), settings.len());
        assert!(folders.contains(&"lambda5e-3-m16-t4".to_string()), "{folders:?}");
    }

    #[test]
    fn tables_and_pictures_hold_every_row_and_no_nonsense() {
        let v = Validation { psnr: Some(21.5), epe3d_moving: Some(3.25), ..empty() };
        let results: Vec<(Row, Found)> = grid()
            .into_iter()
            .enumerate()
            .map(|(k, row)| (row, if k == 0 { Found::Ended("step 3: loss rgb".into()) } else { Found::Figures(v) }))
            .collect();
        let svg = picture(&results);
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        assert_eq!(svg.matches("<rect").count(), 1 + 2 * 20);
        assert_eq!(svg.matches("ended").count(), 2);
        let all_ended: Vec<_> = results.iter().map(|(r, _)| (r.clone(), results[0].1.clone())).collect();
        assert!(!picture(&all_ended).contains("NaN"));
    }
}
