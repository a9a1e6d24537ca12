//! Everything measured as Markdown, as a picture, and as JSON.

use serde::Serialize;
use serde_json::Value;

use super::drives::Drives;
use super::network::Setting;
use super::pairs::median;
use super::peers::Peer;
use super::repeat::Repeat;
use super::sizes::{Point, rate};
use crate::engine::figures::Figures;

/// What came out.
#[derive(Debug, Default, Serialize)]
pub(super) struct Report {
    /// The machine.
    pub machine: Value,
    /// The command line.
    pub command: String,
    /// Load of the machine when it began, where known: other programs make times longer.
    pub load: Option<f64>,
    pub settings: Vec<Setting>,
    /// Per setting of a drive: its name, the keys it changes, and what came out.
    pub drives: Vec<DriveSetting>,
    pub baselines: Vec<Baseline>,
    pub sizes: Vec<Point>,
    pub world: Value,
    pub peers: Vec<Peer>,
    /// Beside an earlier bench.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub repeat: Option<Repeat>,
}

#[derive(Debug, Serialize)]
pub(super) struct DriveSetting {
    pub setting: String,
    /// Configuration keys it changes.
    pub set: Vec<String>,
    #[serde(flatten)]
    pub drives: Drives,
}

#[derive(Debug, Serialize)]
pub(super) struct Baseline {
    pub method: &'static str,
    #[serde(flatten)]
    pub figures: Figures,
}

fn cell(x: Option<f64>, digits: usize) -> String {
    x.map_or("-".into(), |x| format!("{x:.digits$}"))
}

fn row(cells: &[String]) -> String {
    format!("| {} |\n", cells.join(" | "))
}

fn head(names: &[&str]) -> String {
    format!("| {} |\n|---|{}\n", names.join(" | "), "---:|".repeat(names.len() - 1))
}

/// The error columns, without unit of PSNR's `against`.
const ERRORS: [&str; 7] =
    ["PSNR, dB", "PSNR, moving, dB", "depth RMSE, m", "EPE3D, m/s", "Acc5", "moving IoU", "PSNR on the bag, dB"];

fn errors(f: &Figures, bag_psnr: Option<f64>) -> [String; 7] {
    [
        cell(f.psnr, 2),
        cell(f.psnr_dynamic, 2),
        cell(f.depth_rmse, 2),
        cell(f.epe3d, 3),
        cell(f.acc5, 3),
        cell(f.moving_iou, 3),
        cell(bag_psnr, 2),
    ]
}

impl Report {
    /// The document; the picture lies beside it under this name.
    pub fn markdown(&self, picture: &str) -> String {
        let mut text = format!(
            "# Run time against error\n\nMade by `{}` on {} ({} threads, {} kernels{}). Times of one run compare with each other; on another \
             machine make your own.\n\n![run time against error]({picture})\n\n",
            self.command,
            self.machine["cpu"].as_str().unwrap_or("an unknown processor"),
            self.machine["threads"],
            self.machine["kernels"].as_str().unwrap_or("unknown"),
            self.load.map_or(String::new(), |l| format!(", load {l:.1} when it began")),
        );
        text += &self.settings_table();
        text += &self.baselines_table();
        text += &self.drives_table();
        text += &self.sizes_table();
        text
    }

    fn settings_table(&self) -> String {
        let mut text = String::from(
            "## Settings\n\nFull steps: the network, then the newest pictures drawn with flow and motion groups. `times less`: each \
             setting's steps are run in turn with the default's, and this is how many times longer those take in the \
             faster half of the turns: it repeats where the times, which whatever else the machine does lengthens, do not. Networks with weights are \
             scored on held-out drives against the truth by `storm eval`'s protocol (more timesteps left out: more pictures held \
             out); those without against their own exact f32 result. FLOPs are counted, not measured.\n\n",
        );
        let mut names = vec![
            "network, setting",
            "step p50, ms",
            "p99",
            "times less",
            "network p50",
            "p99",
            "drawing p50",
            "p99",
            "tokens",
            "GFLOP",
            "peak, MB",
            "against",
        ];
        names.extend(ERRORS);
        text += &head(&names);
        for s in &self.settings {
            let stage = |name: &str, get: fn(&crate::pipeline::timing::StageStats) -> f64| {
                cell(s.stages_ms.get(name).map(get), 1)
            };
            let mut cells = vec![
                format!("{}, {}", s.model, s.setting),
                stage("step", |t| t.p50),
                stage("step", |t| t.p99),
                cell(s.times_less, 2),
                stage("network", |t| t.p50),
                stage("network", |t| t.p99),
                stage("render", |t| t.p50),
                stage("render", |t| t.p99),
                s.tokens.to_string(),
                format!("{:.1}", s.gflop),
                cell(s.peak_rss_mb, 0),
                if s.against == super::network::TRUTH { "truth".into() } else { "itself, exact".to_string() },
            ];
            cells.extend(errors(&s.figures, s.bag_psnr));
            text += &row(&cells);
        }
        for peer in self.peers.iter().filter(|peer| peer.median_s.is_some()) {
            let ms = peer.median_s.map(|s| 1e3 * s);
            let mut cells = vec![format!("PyTorch, B/8's shapes, {}", peer.name), cell(ms, 1), "-".into()];
            cells.extend([cell(peer.times_less, 2), cell(ms, 1)]);
            cells.extend(["-", "-", "-", "7220", "-"].map(String::from));
            cells.push(cell(peer.said["peak_rss_mb"].as_f64(), 0));
            cells.extend(["-"; 8].map(String::from));
            text += &row(&cells);
        }
        text + "\n"
    }

    /// Sets each peer's `times_less`, by the medians: steps of the largest network's default from all rows, for peers are
    /// timed before the first and after the last of them.
    pub fn compare_peers(&mut self) {
        let of_largest = || self.settings.iter().filter(|s| s.model == super::LARGEST);
        let own = of_largest().filter(|s| s.times_less.is_none()).flat_map(|s| &s.turns_ms.one);
        let beside = of_largest().flat_map(|s| &s.turns_ms.other);
        let ours = median(own.chain(beside).copied().collect());
        for peer in &mut self.peers {
            peer.times_less = ours.zip(peer.median_s).map(|(ms, s)| ms / 1e3 / s);
        }
    }

    fn baselines_table(&self) -> String {
        if self.baselines.is_empty() {
            return String::new();
        }
        let mut names = vec!["method", "ms per window"];
        names.extend(&ERRORS[..6]);
        let mut text =
            String::from("## Other methods\n\nOn the same clips as `tiny` above (names: README, Held-out error).\n\n")
                + &head(&names);
        for b in &self.baselines {
            let mut cells = vec![format!("`{}`", b.method), cell(b.figures.ms, 0)];
            cells.extend(errors(&b.figures, None).into_iter().take(6));
            text += &row(&cells);
        }
        text + "\n"
    }

    fn drives_table(&self) -> String {
        if self.drives.is_empty() {
            return String::new();
        }
        let mut text = String::from(
            "## Skipping\n\n`tiny` over drives at 10 Hz, everything asked for (map, trajectories, objects, pictures): mean time per step with \
             every step computed and with the setting's ladder, on the same windows. Errors are of scenes against the truth, full \
             and with the ladder. `mixed` is all of them one after the other; its `times less` is the mean of the three, each step counted \
             alike.\n\n",
        );
        text += &head(&[
            "setting",
            "drive",
            "steps",
            "still",
            "predicted",
            "approximate",
            "full, ms",
            "ladder, ms",
            "times less",
            "a still step, ms",
            "a predicted one, ms",
            "PSNR, dB",
            "EPE3D, m/s",
            "moving IoU",
            "checks",
            "broken",
        ]);
        for s in &self.drives {
            for r in &s.drives.rows {
                let both = |get: fn(&Figures) -> Option<f64>, digits| {
                    let of = |f: &Option<Figures>| cell(f.as_ref().and_then(get), digits);
                    format!("{} / {}", of(&r.full), of(&r.skipping))
                };
                let mixed = r.drive == "mixed";
                let count = |n: u64| if mixed { n.to_string() } else { String::new() };
                text += &row(&[
                    s.setting.clone(),
                    r.drive.into(),
                    r.steps.to_string(),
                    r.still.to_string(),
                    r.predicted.to_string(),
                    r.approximate.to_string(),
                    format!("{:.1}", r.full_ms),
                    format!("{:.1}", r.ms),
                    format!("{:.2}", r.ratio),
                    cell(r.still_ms, 2),
                    cell(r.predicted_ms, 2),
                    both(|f| f.psnr, 2),
                    both(|f| f.epe3d, 3),
                    both(|f| f.moving_iou, 3),
                    count(s.drives.skips.checks),
                    count(s.drives.skips.broken),
                ]);
            }
        }
        text += "\nStages of a full step of these drives, everything asked for:\n\n";
        text += &head(&["stage", "p50, ms", "p99, ms"]);
        for (stage, t) in self.drives.iter().take(1).flat_map(|s| &s.drives.stages_ms) {
            text += &row(&[stage.clone(), format!("{:.2}", t.p50), format!("{:.2}", t.p99)]);
        }
        text + "\n"
    }

    fn sizes_table(&self) -> String {
        if self.sizes.is_empty() {
            return String::new();
        }
        let mut text = String::from(
            "## Cost against size\n\nThe network alone, of `tiny`'s width and without weights, in f32. `times the usual`: beside passes of \
             4 timesteps of 3 cameras at 96x64, run in turn. The last column is the counted work at the rate of the curve's largest window.\n\n",
        ) + &head(&[
            "curve",
            "timesteps",
            "cameras",
            "picture",
            "tokens",
            "GFLOP",
            "measured, ms",
            "times the usual",
            "counted, ms",
        ]);
        for p in &self.sizes {
            let curve: Vec<&Point> = self.sizes.iter().filter(|q| q.curve == p.curve).collect();
            text += &row(&[
                p.curve.into(),
                p.timesteps.to_string(),
                p.cameras.to_string(),
                format!("{}x{}", p.picture[0], p.picture[1]),
                p.tokens.to_string(),
                format!("{:.2}", p.gflop),
                format!("{:.1}", p.network_ms),
                format!("{:.2}", p.times_usual),
                format!("{:.1}", p.gflop / rate(&curve)),
            ]);
        }
        text + "\n"
    }
}

#[cfg(test)]
mod tests {
    use super::super::pairs::Pairs;
    use super::*;
    use crate::pipeline::timing::StageStats;

    fn setting(name: &str, ms: f64, psnr: f64) -> Setting {
        let stats = StageStats { p50: ms, p99: 2.0 * ms };
        Setting {
            model: "tiny".into(),
            weights: "w".into(),
            setting: name.into(),
            dtype: "f32".into(),
            skips: Vec::new(),
            tokens: 1172,
            gflop: 10.0,
            gaussians: 1,
            picture: [96, 64],
            clips: 1,
            step_ms: stats.clone(),
            times_less: (name != "default").then_some(1.5),
            turns_ms: Pairs::default(),
            stages_ms: [("step".to_string(), stats)].into(),
            peak_rss_mb: Some(100.0),
            against: super::super::network::TRUTH,
            figures: Figures { psnr: Some(psnr), epe3d: Some(0.5), ..Figures::default() },
            bag_psnr: None,
        }
    }

    fn peer(median_s: Option<f64>) -> Peer {
        Peer { name: "f32, eager", seconds: Vec::new(), median_s, times_less: None, said: Value::Null, failed: None }
    }

    #[test]
    fn tables_are_even_and_the_picture_has_every_setting() {
        let point = |tokens, gflop, network_ms| Point {
            curve: "tokens",
            timesteps: 4,
            cameras: 3,
            picture: [96, 64],
            tokens,
            gflop,
            network_ms,
            times_usual: network_ms / 100.0,
            turns_ms: Pairs::default(),
        };
        let report = Report {
            settings: vec![setting("default", 100.0, 22.5), setting("int8", 60.0, 22.4)],
            baselines: vec![Baseline { method: "static", figures: Figures { ms: Some(90.0), ..Figures::default() } }],
            sizes: vec![point(404, 1.0, 12.0), point(10_388, 100.0, 1000.0)],
            peers: vec![peer(Some(26.6)), peer(None)],
            ..Report::default()
        };
        let text = report.markdown("bench.svg");
        for table in text.split("\n\n").filter(|part| part.starts_with('|')) {
            let widths: Vec<usize> = table.lines().map(|l| l.matches('|').count()).collect();
            assert!(widths.iter().all(|w| *w == widths[0]), "{table}");
        }
        assert!(text.contains("| 12.0 | 0.12 | 10.0 |"), "counted at the largest one's rate: {text}");
        let svg = report.picture();
        assert!(svg.contains("tiny, int8") && svg.contains("counted FLOPs") && !svg.contains("NaN"), "{svg}");
        assert!(svg.contains("font-weight=\"bold\">1 tiny, default"), "the default is marked: {svg}");
        assert!(!Report::default().picture().contains("NaN"));
    }

    #[test]
    fn the_peer_stands_beside_all_steps_of_the_largest_default() {
        let turns = |one: &[f64], other: &[f64]| Pairs { one: one.to_vec(), other: other.to_vec() };
        let mut own = Setting { model: "b8".into(), times_less: None, ..setting("default", 1.0, 0.0) };
        own.turns_ms = turns(&[25e3, 26e3, 24e3], &[]);
        let mut int8 = Setting { model: "b8".into(), ..setting("int8", 1.0, 0.0) };
        int8.turns_ms = turns(&[15e3, 15e3], &[21e3, 20e3]);
        let settings = vec![setting("default", 100.0, 22.5), own, int8];
        let mut report = Report { settings, peers: vec![peer(None), peer(Some(30.0))], ..Report::default() };
        report.compare_peers();
        let ratios: Vec<_> = report.peers.iter().map(|peer| peer.times_less).collect();
        assert_eq!(ratios, [None, Some(0.8)], "24 s, not its own row's 25 s nor int8's 15 s");
    }
}
