//! Curves of a training run: `losses.csv`, `validation.csv` and a picture of both, `curves.svg`.

use std::fmt::Write as _;
use std::fs::{File, OpenOptions};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use storm_model::train::{StepReport, Validation};

use crate::output::atomic::write_bytes;
use crate::output::plot::{self, Axis, Drawn, Panel, Series};

/// Every loss term there is; those a run does not have stay empty.
const TERMS: [&str; 20] = [
    "rgb",
    "log_depth",
    "depth",
    "pixel_depth",
    "color",
    "opacity",
    "scale",
    "sky_color",
    "velocity",
    "flow",
    "groups",
    "structure",
    "lpips",
    "sky_opacity",
    "bases",
    "swept_depth",
    "sky_depth",
    "opaque",
    "total",
    "learning_rate",
];

/// Columns after the terms: how long the step took, seconds.
const REST: [&str; 5] = ["gradient_norm", "wait_sec", "forward_sec", "backward_sec", "update_sec"];

/// A column of `validation.csv` and its value.
type Figure = (&'static str, fn(&Validation) -> Option<f64>);

const FIGURES: [Figure; 17] = [
    ("depth_relative", |v| v.depth_relative),
    ("depth_rmse", |v| v.depth_rmse),
    ("epe3d", |v| v.epe3d),
    ("epe3d_moving", |v| v.epe3d_moving),
    ("epe3d_moving_still", |v| v.epe3d_moving_still),
    ("psnr", |v| v.psnr),
    ("opacity_surface", |v| v.opacity_surface),
    ("opacity_sky", |v| v.opacity_sky),
    ("missed_share", |v| v.missed_share),
    ("speed_error", |v| v.speed_error),
    ("direction_error", |v| v.direction_error),
    ("epe3d_foreground_dynamic", |v| v.epe3d_foreground_dynamic),
    ("epe3d_foreground_static", |v| v.epe3d_foreground_static),
    ("epe3d_background_static", |v| v.epe3d_background_static),
    ("moving_iou", |v| v.moving_iou),
    ("bases_from_fan", |v| v.bases_from_fan),
    ("bases_between_clips", |v| v.bases_between_clips),
];

/// Points drawn per line; more are averaged.
const POINTS: usize = 400;

/// Rows of numbers, one file.
pub(super) struct Table {
    path: PathBuf,
    file: BufWriter<File>,
    /// Step, then one value per column.
    rows: Vec<(u64, Vec<Option<f64>>)>,
}

impl Table {
    /// Opens a table and drops what an earlier run wrote from step `first` on (it is trained again).
    pub fn open(path: PathBuf, columns: &[&str], first: u64) -> Result<Self> {
        let text = std::fs::read_to_string(&path).unwrap_or_default();
        // A run of an earlier version had fewer columns: they are found by their names.
        let header: Vec<&str> = text.lines().next().unwrap_or_default().split(',').skip(1).collect();
        let places: Vec<Option<usize>> = columns.iter().map(|c| header.iter().position(|h| h == c)).collect();
        let row = |line: &str| {
            let mut cells = line.split(',');
            let step: u64 = cells.next()?.parse().ok()?;
            let found: Vec<Option<f64>> = cells.map(|c| c.parse().ok()).collect();
            let values: Vec<Option<f64>> =
                places.iter().map(|place| place.and_then(|p| found.get(p).copied().flatten())).collect();
            (step < first && found.len() == header.len()).then_some((step, values))
        };
        let rows: Vec<_> = text.lines().skip(1).filter_map(row).collect();
        let mut whole = format!("step,{}\n", columns.join(","));
        rows.iter().for_each(|(step, values)| whole += &line(*step, values));
        write_bytes(&path, whole.as_bytes())?;
        let file =
            OpenOptions::new().append(true).open(&path).with_context(|| format!("cannot write {}", path.display()))?;
        Ok(Self { path, file: BufWriter::new(file), rows })
    }

    /// Adds a row.
    pub fn push(&mut self, step: u64, values: Vec<Option<f64>>) -> Result<()> {
        self.file
            .write_all(line(step, &values).as_bytes())
            .and_then(|()| self.file.flush())
            .with_context(|| format!("cannot write {}", self.path.display()))?;
        self.rows.push((step, values));
        Ok(())
    }

    /// One column, averaged over stretches of steps.
    fn series(&self, column: usize) -> Vec<(f64, f64)> {
        let stretch = self.rows.len().div_ceil(POINTS).max(1);
        let mean = |rows: &[(u64, Vec<Option<f64>>)]| {
            let values: Vec<f64> = rows.iter().filter_map(|(_, v)| v.get(column).copied().flatten()).collect();
            let step = rows.iter().map(|(s, _)| *s as f64).sum::<f64>() / rows.len() as f64;
            (!values.is_empty()).then(|| (step, values.iter().sum::<f64>() / values.len() as f64))
        };
        self.rows.chunks(stretch).filter_map(mean).collect()
    }
}

fn line(step: u64, values: &[Option<f64>]) -> String {
    let mut out = step.to_string();
    for value in values {
        out.push(',');
        if let Some(x) = value {
            // Writing into a string cannot fail.
            let _ = write!(out, "{x:.6e}");
        }
    }
    out + "\n"
}

/// The files of a run.
pub(super) struct Curves {
    losses: Table,
    figures: Table,
    picture: PathBuf,
}

impl Curves {
    /// Curves in a folder, for a run that starts at step `first`.
    pub fn open(folder: &Path, first: u64) -> Result<Self> {
        let columns: Vec<&str> = TERMS.iter().chain(&REST).copied().collect();
        Ok(Self {
            losses: Table::open(folder.join("losses.csv"), &columns, first)?,
            figures: Table::open(folder.join("validation.csv"), &FIGURES.map(|(name, _)| name), first + 1)?,
            picture: folder.join("curves.svg"),
        })
    }

    /// One step; `wait_sec` is how long it waited for its clips.
    pub fn step(&mut self, report: &StepReport, wait_sec: f64) -> Result<()> {
        let term = |name: &&str| match *name {
            "total" => Some(report.total),
            "learning_rate" => Some(report.learning_rate),
            name => report.terms.iter().find(|(n, _)| *n == name).map(|(_, x)| *x),
        };
        let [forward, backward, update] = report.seconds;
        let rest = [report.gradient_norm, wait_sec, forward, backward, update].map(Some);
        self.losses.push(report.step, TERMS.iter().map(term).chain(rest).collect())
    }

    /// Error figures after `steps` steps; also draws the picture anew.
    pub fn validation(&mut self, steps: u64, v: &Validation) -> Result<()> {
        let values = FIGURES.iter().map(|(_, value)| value(v)).collect();
        self.figures.push(steps, values)?;
        self.draw()
    }

    /// Draws the picture.
    fn draw(&mut self) -> Result<()> {
        let losses: Vec<(&str, Vec<(f64, f64)>)> = TERMS[..16]
            .iter()
            .enumerate()
            .map(|(k, name)| (*name, self.losses.series(k)))
            .filter(|(_, points)| !points.is_empty())
            .collect();
        let figure = |wanted: &'static str| {
            let column = FIGURES.iter().position(|(name, _)| *name == wanted);
            (wanted, column.map_or(Vec::new(), |k| self.figures.series(k)))
        };
        let panels = [
            panel("Loss terms (weighted, logarithmic)", &losses, true),
            panel("Held-out depth error over depth", &[figure("depth_relative")], false),
            panel(
                "Held-out velocity error of moving pixels, m/s (dashes: taken as still)",
                &[figure("epe3d_moving"), figure("epe3d_moving_still")],
                false,
            ),
            panel("Share of moving road users' pixels that are missed", &[figure("missed_share")], false),
            panel("Held-out PSNR of rendered pictures, dB", &[figure("psnr")], false),
        ];
        Ok(write_bytes(&self.picture, plot::svg(&panels).as_bytes())?)
    }
}

/// Smaller loss terms are drawn as this.
const LOSS_FLOOR: f64 = 1e-5;

fn panel(title: &str, lines: &[(&str, Vec<(f64, f64)>)], log: bool) -> Panel {
    let series = |(name, points): &(&str, Vec<(f64, f64)>)| Series {
        name: (*name).into(),
        points: points.iter().map(|&(x, y)| (x, if log { y.max(LOSS_FLOOR) } else { y })).collect(),
        drawn: if name.ends_with("still") { Drawn::Dashed } else { Drawn::Line },
    };
    let y = Axis { label: String::new(), log };
    Panel { title: title.into(), x: Axis::linear("step"), y, series: lines.iter().map(series).collect() }
}

/// Error figures in one line.
pub(super) fn describe(v: &Validation) -> String {
    let one = |x: Option<f64>| x.map_or("-".into(), |x| format!("{x:.3}"));
    format!(
        "depth error {} (RMSE {} m), velocity error {} m/s, of movers {} (taken as still {}), missed {} of them, speed error \
         {} m/s, direction error {} rad; velocity bases {} m/s from their start, {} between clips; PSNR {} dB, opacity {} on \
         surfaces, {} in the sky",
        one(v.depth_relative),
        one(v.depth_rmse),
        one(v.epe3d),
        one(v.epe3d_moving),
        one(v.epe3d_moving_still),
        one(v.missed_share),
        one(v.speed_error),
        one(v.direction_error),
        one(v.bases_from_fan),
        one(v.bases_between_clips),
        one(v.psnr),
        one(v.opacity_surface),
        one(v.opacity_sky)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(step: u64) -> StepReport {
        StepReport {
            step,
            total: 1.0 / (step + 1) as f64,
            terms: vec![("depth", 0.5), ("flow", 0.25)],
            learning_rate: 1e-3,
            gradient_norm: 2.0,
            seconds: [0.1, 0.2, 0.3],
        }
    }

    #[test]
    fn a_table_of_an_earlier_version_keeps_its_columns() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("table.csv");
        std::fs::write(&path, "step,gone,psnr,epe3d\n10,1.0,20.5,\n20,1.0,21.5,0.5\n30,2.0,23.0\n").unwrap();
        let table = Table::open(path.clone(), &["epe3d", "missed_share", "psnr"], 100).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        assert_eq!(text, "step,epe3d,missed_share,psnr\n10,,,2.050000e1\n20,5.000000e-1,,2.150000e1\n");
        assert_eq!(table.series(2), [(10.0, 20.5), (20.0, 21.5)]);
    }

    #[test]
    fn a_resumed_run_continues_its_tables() {
        let dir = tempfile::tempdir().unwrap();
        let mut curves = Curves::open(dir.path(), 0).unwrap();
        (0..6).for_each(|k| curves.step(&report(k), 0.05).unwrap());
        let v = Validation {
            depth_relative: Some(0.3),
            epe3d_moving: Some(4.0),
            epe3d_moving_still: Some(5.0),
            missed_share: Some(0.24),
            psnr: Some(20.0),
            ..Validation::default()
        };
        curves.validation(6, &v).unwrap();
        drop(curves);
        // Resumed from a checkpoint of step 4: steps 4 and 5 are trained again.
        let mut curves = Curves::open(dir.path(), 4).unwrap();
        (4..8).for_each(|k| curves.step(&report(k), 0.05).unwrap());
        curves.validation(8, &v).unwrap();
        let text = std::fs::read_to_string(dir.path().join("losses.csv")).unwrap();
        let steps: Vec<&str> = text.lines().skip(1).map(|l| l.split(',').next().unwrap()).collect();
        assert_eq!(steps, ["0", "1", "2", "3", "4", "5", "6", "7"]);
        let columns = text.lines().next().unwrap().split(',').count();
        assert!(text.lines().all(|l| l.split(',').count() == columns));
        let validation = std::fs::read_to_string(dir.path().join("validation.csv")).unwrap();
        assert_eq!(validation.lines().count(), 2, "{validation}");
        let svg = std::fs::read_to_string(dir.path().join("curves.svg")).unwrap();
        assert!(
            validation.starts_with("step,depth_relative,") && validation.contains(",missed_share,"),
            "{validation}"
        );
        assert!(svg.contains("flow") && svg.contains("PSNR") && !svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
