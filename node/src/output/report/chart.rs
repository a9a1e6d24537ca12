//! Stage timings as bars: the median solid, the 99th percentile as a lighter tail.

use super::StageTiming;
use super::html::{duration, escape};

/// Sizes in SVG units (pixels at full width).
const WIDTH: f64 = 900.0;
const LABEL_WIDTH: f64 = 130.0;
const VALUE_WIDTH: f64 = 150.0;
const ROW_HEIGHT: f64 = 26.0;
const BAR_HEIGHT: f64 = 12.0;

/// The chart; bars are linear from 0 to the largest 99th percentile.
pub(super) fn timing_chart(timings: &[StageTiming]) -> String {
    let finite = |ms: f64| if ms.is_finite() { ms.max(0.0) } else { 0.0 };
    let longest = timings.iter().map(|t| finite(t.p99_ms).max(finite(t.p50_ms))).fold(0.0, f64::max);
    let span = WIDTH - LABEL_WIDTH - VALUE_WIDTH;
    let length = |ms: f64| if longest > 0.0 { finite(ms) / longest * span } else { 0.0 };
    let height = ROW_HEIGHT * timings.len() as f64 + 4.0;
    let mut svg = format!(
        "<svg class=\"chart\" viewBox=\"0 0 {WIDTH} {height}\" role=\"img\" aria-label=\"Run time of each stage\">\n"
    );
    for (i, t) in timings.iter().enumerate() {
        let middle = ROW_HEIGHT * (i as f64 + 0.5) + 2.0;
        let top = middle - 0.5 * BAR_HEIGHT;
        let (p50, p99) = (length(t.p50_ms), length(t.p99_ms));
        svg.push_str(&format!(
            "<g><title>{name}: p50 {a}, p99 {b}</title>\
             <text class=\"label\" x=\"{lx}\" y=\"{middle}\">{name}</text>\
             <rect class=\"track\" x=\"{LABEL_WIDTH}\" y=\"{top}\" width=\"{span}\" height=\"{BAR_HEIGHT}\" rx=\"3\"/>\
             <rect class=\"p99\" x=\"{LABEL_WIDTH}\" y=\"{top}\" width=\"{p99:.1}\" height=\"{BAR_HEIGHT}\" rx=\"3\"/>\
             <rect class=\"p50\" x=\"{LABEL_WIDTH}\" y=\"{top}\" width=\"{p50:.1}\" height=\"{BAR_HEIGHT}\" rx=\"3\"/>\
             <text class=\"value\" x=\"{vx}\" y=\"{middle}\">{a}<tspan class=\"faint\"> · {b}</tspan></text></g>\n",
            name = escape(&t.name),
            a = duration(t.p50_ms),
            b = duration(t.p99_ms),
            lx = LABEL_WIDTH - 12.0,
            vx = WIDTH - VALUE_WIDTH + 12.0,
        ));
    }
    svg + "</svg>\n"
}
