//! `report.html`: one file that shows a run, with no address outside itself.
//!
//! The caller fills a plain [`Report`]; what is empty is left out of the page. Pictures are embedded as PNG, charts are
//! inline SVG, the only style sheet is inline, there is no script, and a content security policy in the page forbids
//! loading anything.

mod chart;
mod html;
mod page;
mod top_view;

use std::path::Path;

use super::OutputError;
use super::atomic::write_bytes;
use super::picture::{Picture, Rgb, TopView};

/// Everything a report shows.
#[derive(Debug, Clone, Default)]
pub struct Report {
    /// Heading, for example the bag's name.
    pub title: String,
    /// One line below it.
    pub subtitle: String,
    /// The weights the run used.
    pub weights: WeightsState,
    /// The numbers worth showing large: label and value (with unit), for example steps, Gaussians, tracks.
    pub highlights: Vec<(String, String)>,
    /// Further facts as a table: name and value.
    pub summary: Vec<(String, String)>,
    /// What was dropped: reason and count; shown as "nothing" when all counts are 0.
    pub drops: Vec<(String, u64)>,
    /// Error figures, if anything could be scored.
    pub errors: Option<ErrorTable>,
    /// The steps shown.
    pub steps: Vec<ReportStep>,
    /// The map from above.
    pub top_view: Option<TopViewSection>,
    /// Run time of each stage, in the order of the pipeline.
    pub timings: Vec<StageTiming>,
    /// The configuration as resolved, YAML.
    pub config_yaml: String,
    /// The other files of the results folder.
    pub files: Vec<ReportFile>,
}

/// Where the network's weights came from.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum WeightsState {
    /// Random weights: results show the data flow, not the scene.
    #[default]
    Untrained,
    /// Trained weights.
    Trained {
        /// File name or the name they ship under.
        name: String,
        /// What they were trained on.
        note: String,
    },
}

/// Error figures of one or several methods.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ErrorTable {
    /// Method names, the first being ours.
    pub methods: Vec<String>,
    /// One row per figure.
    pub rows: Vec<ErrorRow>,
    /// What was compared with what.
    pub note: String,
}

/// One error figure.
#[derive(Debug, Clone, PartialEq)]
pub struct ErrorRow {
    /// Name, for example `PSNR`.
    pub name: String,
    /// Unit, empty for ratios.
    pub unit: String,
    /// True when more is better.
    pub higher_is_better: bool,
    /// One value per method; `None` where it could not be computed.
    pub values: Vec<Option<f64>>,
}

/// One step: what went in and what came out, per camera.
#[derive(Debug, Clone)]
pub struct ReportStep {
    /// Number of the step in the run.
    pub index: usize,
    /// Stamp of the window's newest timestep, nanoseconds.
    pub stamp_ns: i64,
    /// Facts about the step, for example Gaussians and run time.
    pub note: String,
    /// One row of pictures per camera.
    pub cameras: Vec<ReportCamera>,
}

/// The pictures of one camera.
#[derive(Debug, Clone)]
pub struct ReportCamera {
    /// Camera name.
    pub name: String,
    /// Input, rendered, depth, flow, mask: whatever there is, in the order shown.
    pub panels: Vec<Panel>,
}

/// One picture with its caption.
#[derive(Debug, Clone)]
pub struct Panel {
    /// What it is.
    pub title: String,
    /// Stamp, units, scale.
    pub caption: String,
    /// The picture.
    pub picture: Picture,
}

/// The map and the trajectories from above.
#[derive(Debug, Clone)]
pub struct TopViewSection {
    /// The part of the map shown.
    pub view: TopView,
    /// The binned points, of the view's size.
    pub picture: Picture,
    /// Trajectories of moving points, map frame, metres.
    pub tracks: Vec<ReportTrack>,
    /// The vehicle's way, map frame, metres.
    pub trajectory: Vec<[f64; 3]>,
    /// What is shown.
    pub caption: String,
}

/// One trajectory.
#[derive(Debug, Clone)]
pub struct ReportTrack {
    /// Points, map frame, metres.
    pub points: Vec<[f64; 3]>,
    /// Line colour.
    pub color: Rgb,
}

/// Run time of one stage.
#[derive(Debug, Clone, PartialEq)]
pub struct StageTiming {
    /// Stage name.
    pub name: String,
    /// Median, milliseconds.
    pub p50_ms: f64,
    /// 99th percentile, milliseconds.
    pub p99_ms: f64,
}

/// A file beside the report.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReportFile {
    /// Name relative to the report.
    pub name: String,
    /// Size, bytes, when known.
    pub bytes: Option<u64>,
    /// What it holds and what opens it.
    pub what: String,
}

impl Report {
    /// The page. Errors only when a picture cannot be encoded.
    pub fn to_html(&self) -> Result<String, OutputError> {
        page::page(self)
    }

    /// Writes the page, whole or not at all.
    pub fn write(&self, path: &Path) -> Result<(), OutputError> {
        write_bytes(path, self.to_html()?.as_bytes())
    }
}

#[cfg(test)]
mod tests;
