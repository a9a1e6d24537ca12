//! The bench as a picture: milliseconds against error, and against size.

use super::network::{Setting, TRUTH};
use super::report::Report;
use super::sizes::{Point, rate};
use crate::engine::figures::Figures;
use crate::output::plot::{self, Axis, Drawn, Panel, Series};

/// One figure of many.
type Get = fn(&Figures) -> Option<f64>;

impl Report {
    /// Milliseconds against error, and against size, where they were measured.
    pub fn picture(&self) -> String {
        let against_truth: Vec<&Setting> = self.settings.iter().filter(|s| s.against == TRUTH).collect();
        let mut panels = Vec::new();
        let figures: [(&str, Get); 2] =
            [("PSNR of held-out pictures, dB", |f| f.psnr), ("EPE3D, m/s (lower is better)", |f| f.epe3d)];
        for (label, get) in figures.into_iter().filter(|_| !against_truth.is_empty()) {
            let mut series: Vec<Series> = against_truth
                .iter()
                .map(|s| Series {
                    name: format!("{}, {}", s.model, s.setting),
                    points: get(&s.figures).map(|y| (s.step_ms.p50, y)).into_iter().collect(),
                    drawn: if s.setting == "default" { Drawn::BoldMark } else { Drawn::Mark },
                })
                .collect();
            series.extend(self.baselines.iter().map(|b| Series {
                name: format!("{} (method)", b.method),
                points: b.figures.ms.zip(get(&b.figures)).into_iter().collect(),
                drawn: Drawn::Mark,
            }));
            panels.push(Panel {
                title: format!("Step time against {label}"),
                x: Axis::log("milliseconds per step, median"),
                y: Axis::linear(label),
                series,
            });
        }
        for curve in ["tokens", "cameras", "timesteps"] {
            let points: Vec<&Point> = self.sizes.iter().filter(|p| p.curve == curve).collect();
            if points.len() < 2 {
                continue;
            }
            let at = |p: &Point| match curve {
                "cameras" => p.cameras as f64,
                "timesteps" => p.timesteps as f64,
                _ => p.tokens as f64,
            };
            let axis = |label: &str| if curve == "tokens" { Axis::log(label) } else { Axis::linear(label) };
            let line = |name: &str, drawn, ms: &dyn Fn(&Point) -> f64| Series {
                name: name.into(),
                points: points.iter().map(|p| (at(p), ms(p))).collect(),
                drawn,
            };
            let speed = rate(&points);
            panels.push(Panel {
                title: format!("Cost of the network against {curve}"),
                x: axis(curve),
                y: axis("ms"),
                series: vec![
                    line("measured", Drawn::Line, &|p| p.network_ms),
                    line("counted FLOPs", Drawn::Dashed, &|p| p.gflop / speed),
                ],
            });
        }
        plot::svg(&panels)
    }
}
