//! The report: keeps pictures of steps spread over the run, whatever its length, and writes the page.

use std::path::Path;
use std::sync::Arc;

use anyhow::Result;
use glam::DVec3;
use storm_model::scene::RenderedView;

use crate::config::Config;
use crate::engine::UNTRAINED;
use crate::map::MapCloud;
use crate::output::picture::{
    DepthScale, Picture, TopView, depth_picture, flow_picture, hatched, mask_overlay, palette, top_view_picture,
    with_depth_bar, with_flow_wheel,
};
use crate::output::report::{
    ErrorRow, ErrorTable, Panel, Report, ReportCamera, ReportFile, ReportStep, ReportTrack, StageTiming,
    TopViewSection, WeightsState,
};
use crate::output::tracks_csv::TrackRow;
use crate::pipeline::metrics::Metrics;
use crate::pipeline::step::Step;
use crate::rigid::Rigid;
use crate::source::{Frame, Rig};
use crate::window::PosedSet;

use crate::pipeline::messages::{motion_mask, surface_depth};

/// Speed at which the flow pictures are fully saturated, m/s.
const FULL_SPEED_MPS: f32 = 15.0;
/// Size of the top view, pixels.
const TOP_VIEW_PX: usize = 900;
/// Most trajectories drawn; the page stays readable.
const TRACKS_DRAWN: usize = 2_000;

/// What a run's folder holds besides the report.
const FILES: [(&str, &str); 7] = [
    ("map.ply", "static map, 3DGS layout, without the sky"),
    ("tracks.csv", "point trajectories, map frame"),
    ("objects.csv", "moving objects: boxes and velocities, map frame"),
    ("outputs.mcap", "what a live node publishes; opens in Foxglove"),
    ("trajectory.tum", "vehicle poses"),
    ("metrics.json", "counts, drops, stage times, error figures"),
    ("config.yaml", "the configuration as resolved"),
];

/// Evenly spread steps: every 2^k-th is kept, k growing with the run, so that memory is bounded and the choice depends
/// only on the number of steps.
pub struct Gallery {
    limit: usize,
    every: u64,
    kept: Vec<Shown>,
}

/// What is kept of a step: its pictures, not its Gaussians.
struct Shown {
    index: u64,
    stamp_ns: i64,
    gaussians: usize,
    total_ms: f64,
    views: Arc<[RenderedView]>,
    inputs: Arc<PosedSet<Frame>>,
}

impl Gallery {
    /// At most `limit` steps in the end.
    pub fn new(limit: usize) -> Self {
        Self { limit, every: 1, kept: Vec::new() }
    }

    /// Shows it a step.
    pub fn offer(&mut self, step: &Step) {
        let Some(newest) = step.window.steps.last() else { return };
        if self.limit == 0 || !step.index.is_multiple_of(self.every) {
            return;
        }
        self.kept.push(Shown {
            index: step.index,
            stamp_ns: step.window.stamp_ns,
            gaussians: step.scene.gaussians.len(),
            total_ms: step.total_ms,
            views: Arc::clone(&step.views),
            inputs: newest.clone(),
        });
        if self.kept.len() > 2 * self.limit {
            self.every *= 2;
            self.kept.retain(|s| s.index % self.every == 0);
        }
    }

    /// `limit` of the kept steps, first and last among them.
    fn chosen(&self) -> Vec<&Shown> {
        let n = self.kept.len();
        let want = self.limit.min(n);
        (0..want).filter_map(|i| self.kept.get(if want > 1 { i * (n - 1) / (want - 1) } else { 0 })).collect()
    }

    /// Writes the page.
    pub fn write(self, path: &Path, rig: &Rig, run: &Run) -> Result<()> {
        let metrics = run.metrics;
        let steps = self.chosen().into_iter().map(|s| report_step(s, rig)).collect::<Result<_>>()?;
        let weights = match metrics.weights.as_str() {
            UNTRAINED => WeightsState::Untrained,
            name => WeightsState::Trained { name: name.into(), note: String::new() },
        };
        let report = Report {
            title: format!("storm: {}", run.title),
            subtitle: match &metrics.no_steps {
                Some(why) => format!("{}; {why}", metrics.model),
                None => format!("{}; {:.1} s recorded", metrics.model, metrics.recorded_sec),
            },
            weights,
            highlights: highlights(metrics),
            summary: summary(metrics, rig),
            drops: metrics.dropped.iter().map(|(reason, n)| (reason.clone(), *n)).collect(),
            errors: metrics.held_out.as_ref().map(|s| error_table(&s.rows())),
            steps,
            // Without a map it would be a black square.
            top_view: (!run.map.is_empty()).then(|| top_view(run)),
            timings: metrics
                .latency_ms
                .iter()
                .map(|(name, s)| StageTiming { name: name.clone(), p50_ms: s.p50, p99_ms: s.p99 })
                .collect(),
            config_yaml: run.config.to_yaml(),
            files: files(path),
        };
        Ok(report.write(path)?)
    }
}

/// What the page shows besides the steps.
pub struct Run<'a> {
    /// Heading.
    pub title: &'a str,
    /// The figures.
    pub metrics: &'a Metrics,
    /// The map.
    pub map: &'a MapCloud,
    /// Trajectory rows, sorted by trajectory.
    pub tracks: &'a [TrackRow],
    /// Vehicle poses.
    pub poses: &'a [(i64, Rigid)],
    /// The configuration.
    pub config: &'a Config,
}

fn highlights(m: &Metrics) -> Vec<(String, String)> {
    let step_ms = m.latency_ms.get("step").map_or(0.0, |s| s.p50);
    [
        ("frames", m.frames_in.to_string()),
        ("steps", m.steps.to_string()),
        ("step, median", format!("{step_ms:.0} ms")),
        ("Gaussians a step", m.gaussians.to_string()),
        ("map Gaussians", m.map_gaussians.to_string()),
        ("trajectories", m.tracks.to_string()),
    ]
    .map(|(k, v)| (k.to_string(), v))
    .to_vec()
}

fn summary(m: &Metrics, rig: &Rig) -> Vec<(String, String)> {
    let mut rows: Vec<(String, String)> = vec![
        ("wall time".into(), format!("{:.1} s for {:.1} s of recording", m.wall_sec, m.recorded_sec)),
        ("peak memory".into(), m.peak_rss_mb.map_or("unknown".into(), |mb| format!("{mb:.0} MB"))),
        ("map origin".into(), format!("{:.3}, {:.3}, {:.3} m", m.origin_m[0], m.origin_m[1], m.origin_m[2])),
        ("clock jumps".into(), m.epochs.to_string()),
    ];
    for (i, c) in rig.cameras.iter().enumerate() {
        let mark = if i == rig.reference { " (anchor)" } else { "" };
        let masked = match c.masked_share() {
            share if share > 0.0 => format!("; {:.1} % of its pixels show nothing and take no part", 100.0 * share),
            _ => String::new(),
        };
        rows.push((format!("camera {i}{mark}"), format!("{}{masked}", c.topic)));
    }
    rows.extend(m.problems.iter().map(|p| ("problem".to_string(), p.clone())));
    rows
}

fn error_table(rows: &[(&str, &str, bool, [Option<f64>; 2])]) -> ErrorTable {
    ErrorTable {
        methods: vec!["storm".into(), "nearest context image".into()],
        rows: rows
            .iter()
            .map(|(name, unit, higher_is_better, values)| ErrorRow {
                name: name.to_string(),
                unit: unit.to_string(),
                higher_is_better: *higher_is_better,
                values: values.to_vec(),
            })
            .collect(),
        note: "Frames that were not context, drawn at their own time and pose, at the network's picture size.".into(),
    }
}

fn report_step(step: &Shown, rig: &Rig) -> Result<ReportStep> {
    let depths: Vec<Vec<f32>> = step.views.iter().map(surface_depth).collect();
    let scale = DepthScale::fit(depths.iter().map(Vec::as_slice));
    let mut cameras = Vec::new();
    for (c, view) in step.views.iter().enumerate() {
        let (w, h) = (view.width, view.height);
        let frame = &step.inputs.frames[c];
        // What shows nothing is not there to be compared.
        let shown =
            |picture: Picture| frame.item.valid.as_ref().map_or(picture.clone(), |valid| hatched(&picture, valid));
        let input = shown(Picture::from_rgb8(w, h, &frame.item.rgb.data)?);
        let rendered = Picture::from_rgb8(w, h, &view.rgb8())?;
        let still = vec![[0.0; 3]; w * h];
        let flow = shown(flow_picture(w, h, view.flow.as_deref().unwrap_or(&still), None, FULL_SPEED_MPS)?);
        let mask: Vec<u16> = motion_mask(view).into_iter().map(u16::from).collect();
        let hatching = if frame.item.valid.is_some() { "; hatched: shows nothing, takes no part" } else { "" };
        let panel = |title: &str, caption: String, picture| Panel { title: title.into(), caption, picture };
        cameras.push(ReportCamera {
            name: rig.cameras[c].topic.clone(),
            panels: vec![
                panel("input", format!("{} ns{hatching}", frame.stamp_ns), input),
                panel("rendered", "the newest picture as the scene shows it".into(), shown(rendered.clone())),
                panel(
                    "depth",
                    "z-depth, m, logarithmic".into(),
                    with_depth_bar(&shown(depth_picture(w, h, &depths[c], scale)?), scale),
                ),
                panel(
                    "flow",
                    "m/s; hue is direction in the ground plane".into(),
                    with_flow_wheel(&flow, FULL_SPEED_MPS),
                ),
                panel("mask", "moving pixels by motion group".into(), shown(mask_overlay(&rendered, &mask)?)),
            ],
        });
    }
    let note = format!("{} Gaussians, {:.0} ms", step.gaussians, step.total_ms);
    Ok(ReportStep { index: step.index as usize, stamp_ns: step.stamp_ns, note, cameras })
}

/// Everything relative to the map's origin, so that UTM coordinates draw as sharply as small ones.
fn top_view(run: &Run) -> TopViewSection {
    let origin = DVec3::from_array(run.metrics.origin_m);
    let points: Vec<[f64; 3]> = run.map.positions.iter().map(|p| p.map(f64::from)).collect();
    let colors: Vec<[u8; 3]> = run.map.colors01.iter().map(|c| c.map(|x| (x * 255.0) as u8)).collect();
    let trajectory: Vec<[f64; 3]> = run.poses.iter().map(|(_, p)| (p.translation - origin).to_array()).collect();
    let view = TopView::fit(&points, &trajectory, TOP_VIEW_PX, TOP_VIEW_PX);
    let tracks = run
        .tracks
        .chunk_by(|a, b| a.track_id == b.track_id)
        .take(TRACKS_DRAWN)
        .map(|rows| ReportTrack {
            points: rows.iter().map(|r| (DVec3::from_array(r.position_m) - origin).to_array()).collect(),
            color: palette((rows[0].track_id % 64) as u16 + 1),
        })
        .collect();
    let caption = format!(
        "{} map Gaussians from above, x to the right, y up; the vehicle's way; trajectories of moving points",
        run.map.len()
    );
    TopViewSection {
        view,
        picture: top_view_picture(&view, &points, &colors, run.config.map.voxel_m),
        tracks,
        trajectory,
        caption,
    }
}

fn files(report: &Path) -> Vec<ReportFile> {
    let size = |name: &str| std::fs::metadata(report.with_file_name(name)).ok().map(|m| m.len());
    let file = |(name, what): (&str, &str)| ReportFile { name: name.into(), bytes: size(name), what: what.into() };
    FILES.into_iter().filter(|(name, _)| size(name).is_some()).map(file).collect()
}
