//! Curves of a training run: `losses.csv`, `validation.csv` and a picture of both, `curves.svg`.

use std::fmt::Write as _;
use std::fs::{File, OpenOptions};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use storm_model::train::{StepReport, Validation};

use crate::output::atomic::write_bytes;

/// Every loss term there is; those a run does not have stay empty.
const TERMS: [&str; 18] = [
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
    "sky_depth",
    "opaque",
    "total",
    "learning_rate",
];

/// Columns after the terms: how long the step took, seconds.
const REST: [&str; 5] = ["gradient_norm", "wait_sec", "forward_sec", "backward_sec", "update_sec"];

const FIGURES: [&str; 8] = [
    "depth_relative",
    "depth_rmse",
    "epe3d",
    "epe3d_moving",
    "epe3d_moving_still",
    "psnr",
    "opacity_surface",
    "opacity_sky",
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
        let row = |line: &str| {
            let mut cells = line.split(',');
            let step: u64 = cells.next()?.parse().ok()?;
            let values: Vec<Option<f64>> = cells.map(|c| c.parse().ok()).collect();
            (step < first && values.len() == columns.len()).then_some((step, values))
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
            figures: Table::open(folder.join("validation.csv"), &FIGURES, first + 1)?,
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
        let values = vec![
            v.depth_relative,
            v.depth_rmse,
            v.epe3d,
            v.epe3d_moving,
            v.epe3d_moving_still,
            v.psnr,
            v.opacity_surface,
            v.opacity_sky,
        ];
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
        let figure = |k: usize| (FIGURES[k], self.figures.series(k));
        let panels = [
            panel(0, "Loss terms (weighted, logarithmic)", &losses, true),
            panel(1, "Held-out depth error over depth", &[figure(0)], false),
            panel(
                2,
                "Held-out velocity error of moving pixels, m/s (dashes: taken as still)",
                &[figure(3), figure(4)],
                false,
            ),
            panel(3, "Held-out PSNR of rendered pictures, dB", &[figure(5)], false),
        ];
        let height = PANEL_HEIGHT * panels.len() as f64;
        let svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height}\" font-family=\"sans-serif\" font-size=\"12\">\n\
             <rect width=\"{WIDTH}\" height=\"{height}\" fill=\"white\"/>\n{}</svg>\n",
            panels.concat()
        );
        Ok(write_bytes(&self.picture, svg.as_bytes())?)
    }
}

/// Sizes in SVG units (pixels at full width).
const WIDTH: f64 = 900.0;
const PANEL_HEIGHT: f64 = 240.0;
const LEFT: f64 = 70.0;
const RIGHT: f64 = 130.0;
const TOP: f64 = 30.0;
const BOTTOM: f64 = 30.0;

/// Smaller values are drawn as this where the axis is logarithmic.
const LOG_FLOOR: f64 = 1e-5;

/// Ten colours that stay apart for colour-blind readers too; further lines repeat them dashed.
const COLORS: [&str; 10] =
    ["#1f77b4", "#d95f02", "#1b9e77", "#7570b3", "#e7298a", "#66a61e", "#a6761d", "#444444", "#17becf", "#b22222"];

fn panel(index: usize, title: &str, lines: &[(&str, Vec<(f64, f64)>)], log: bool) -> String {
    let scaled = |y: f64| if log { y.max(LOG_FLOOR).log10() } else { y };
    let all = || lines.iter().flat_map(|(_, points)| points.iter());
    let range = |values: &mut dyn Iterator<Item = f64>| {
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
        match (low.is_finite() && high.is_finite(), high > low) {
            (false, _) => (0.0, 1.0),
            (true, false) => (low - 0.5, high + 0.5),
            (true, true) => (low, high),
        }
    };
    let (x0, x1) = range(&mut all().map(|p| p.0));
    let (y0, y1) = range(&mut all().map(|p| scaled(p.1)));
    let top = PANEL_HEIGHT * index as f64;
    let (w, h) = (WIDTH - LEFT - RIGHT, PANEL_HEIGHT - TOP - BOTTOM);
    let px = |x: f64| LEFT + (x - x0) / (x1 - x0) * w;
    let py = |y: f64| top + TOP + (1.0 - (y - y0) / (y1 - y0)) * h;
    let mut svg = format!(
        "<text x=\"{LEFT}\" y=\"{}\" font-weight=\"bold\">{title}</text>\n<rect x=\"{LEFT}\" y=\"{}\" width=\"{w}\" height=\"{h}\" fill=\"none\" stroke=\"#999\"/>\n",
        top + 20.0,
        top + TOP
    );
    for k in 0..5 {
        let y = y0 + (y1 - y0) * f64::from(k) / 4.0;
        let label = if log { format!("{:.1e}", 10f64.powf(y)) } else { format!("{y:.3}") };
        let at = py(y);
        svg += &format!(
            "<line x1=\"{LEFT}\" x2=\"{}\" y1=\"{at:.1}\" y2=\"{at:.1}\" stroke=\"#ddd\"/><text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{label}</text>\n",
            LEFT + w,
            LEFT - 6.0,
            at + 4.0
        );
    }
    for (x, anchor) in [(x0, "start"), (x1, "end")] {
        svg += &format!(
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"{anchor}\">step {x:.0}</text>\n",
            px(x),
            top + PANEL_HEIGHT - 12.0
        );
    }
    for (k, (name, points)) in lines.iter().enumerate() {
        let color = COLORS[k % COLORS.len()];
        let dash = if k >= COLORS.len() || name.ends_with("still") { " stroke-dasharray=\"5 4\"" } else { "" };
        let path: Vec<String> = points.iter().map(|p| format!("{:.1},{:.1}", px(p.0), py(scaled(p.1)))).collect();
        svg += &format!(
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"1.5\"{dash}/>\n\
             <text x=\"{}\" y=\"{:.1}\" fill=\"{color}\">{name}</text>\n",
            path.join(" "),
            LEFT + w + 8.0,
            top + TOP + 12.0 + 14.0 * k as f64
        );
    }
    svg
}

/// Error figures in one line.
pub(super) fn describe(v: &Validation) -> String {
    let one = |x: Option<f64>| x.map_or("-".into(), |x| format!("{x:.3}"));
    format!(
        "depth error {} (RMSE {} m), velocity error {} m/s, of movers {} (taken as still {}), PSNR {} dB, opacity {} on surfaces, {} in the sky",
        one(v.depth_relative),
        one(v.depth_rmse),
        one(v.epe3d),
        one(v.epe3d_moving),
        one(v.epe3d_moving_still),
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
    fn a_resumed_run_continues_its_tables() {
        let dir = tempfile::tempdir().unwrap();
        let mut curves = Curves::open(dir.path(), 0).unwrap();
        (0..6).for_each(|k| curves.step(&report(k), 0.05).unwrap());
        let v = Validation {
            depth_relative: Some(0.3),
            depth_rmse: None,
            epe3d: Some(1.0),
            epe3d_moving: Some(4.0),
            epe3d_moving_still: Some(5.0),
            psnr: Some(20.0),
            opacity_surface: Some(0.9),
            opacity_sky: None,
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
        assert!(svg.contains("flow") && svg.contains("PSNR") && !svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
