//! The map from above as one SVG: the binned picture with trajectories, the vehicle's way and a scale bar over it.

use super::html::{escape, number};
use super::{OutputError, ReportTrack, TopViewSection};

/// Points closer than this to the last one drawn (pixels) are skipped: the eye cannot tell, the file is smaller.
const MIN_SPACING_PX: f64 = 0.75;

/// `x,y x,y ...` of a line, thinned; empty when fewer than two points are finite.
fn polyline(section: &TopViewSection, points: &[[f64; 3]]) -> String {
    let mut drawn: Vec<(f64, f64)> = Vec::new();
    let last = points.len().saturating_sub(1);
    for (i, &p) in points.iter().enumerate() {
        let (x, y) = section.view.project(p);
        let far = drawn.last().is_none_or(|&(a, b)| (x - a).hypot(y - b) >= MIN_SPACING_PX);
        if x.is_finite() && y.is_finite() && (far || i == last) {
            drawn.push((x, y));
        }
    }
    match drawn.len() {
        0 | 1 => String::new(),
        _ => drawn.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect::<Vec<_>>().join(" "),
    }
}

fn track(section: &TopViewSection, track: &ReportTrack) -> String {
    let [r, g, b] = track.color;
    match polyline(section, &track.points) {
        line if line.is_empty() => String::new(),
        line => format!("<polyline class=\"moving\" stroke=\"#{r:02x}{g:02x}{b:02x}\" points=\"{line}\"/>\n"),
    }
}

/// The figure.
pub(super) fn top_view_figure(section: &TopViewSection) -> Result<String, OutputError> {
    let (w, h) = (section.picture.width() as f64, section.picture.height() as f64);
    // Lines and letters keep their share of the picture whatever its size.
    let unit = (w.max(h) / 1000.0).max(0.2);
    let mut svg = format!(
        "<svg class=\"top-view\" viewBox=\"0 0 {w} {h}\" role=\"img\" aria-label=\"Map and trajectories from above\">\n\
         <image width=\"{w}\" height=\"{h}\" href=\"{}\"/>\n<g fill=\"none\" stroke-width=\"{:.2}\" \
         stroke-linejoin=\"round\" stroke-linecap=\"round\">\n",
        section.picture.data_uri()?,
        1.6 * unit
    );
    section.tracks.iter().for_each(|t| svg.push_str(&track(section, t)));
    svg.push_str("</g>\n");
    let line = polyline(section, &section.trajectory);
    if !line.is_empty() {
        for (class, width) in [("way-halo", 5.0), ("way", 2.4)] {
            svg.push_str(&format!(
                "<polyline class=\"{class}\" fill=\"none\" stroke-width=\"{:.2}\" points=\"{line}\"/>\n",
                width * unit
            ));
        }
    }
    for (class, p) in [("start", section.trajectory.first()), ("end", section.trajectory.last())] {
        if let Some((x, y)) = p.map(|p| section.view.project(*p)).filter(|(x, y)| x.is_finite() && y.is_finite()) {
            svg.push_str(&format!(
                "<circle class=\"{class}\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{:.2}\" stroke-width=\"{:.2}\"/>\n",
                6.0 * unit,
                2.0 * unit
            ));
        }
    }
    svg.push_str(&scale_bar(section, w, h, unit));
    svg.push_str("</svg>\n");
    Ok(format!("<figure class=\"wide\">{svg}<figcaption>{}</figcaption></figure>\n", escape(&section.caption)))
}

fn scale_bar(section: &TopViewSection, width: f64, height: f64, unit: f64) -> String {
    let bar_m = section.view.scale_bar_m();
    let length = bar_m / section.view.m_per_px;
    let (right, bottom) = (width - 20.0 * unit, height - 20.0 * unit);
    let left = right - length;
    let label = if bar_m >= 1000.0 { format!("{} km", bar_m / 1000.0) } else { format!("{} m", trimmed(bar_m)) };
    format!(
        "<path class=\"scale\" fill=\"none\" stroke-width=\"{:.2}\" d=\"M{left:.1} {:.1}V{bottom:.1}H{right:.1}V{:.1}\"/>\n\
         <text class=\"scale-text\" x=\"{:.1}\" y=\"{:.1}\" font-size=\"{:.1}\">{label}</text>\n",
        2.0 * unit,
        bottom - 8.0 * unit,
        bottom - 8.0 * unit,
        0.5 * (left + right),
        bottom - 12.0 * unit,
        20.0 * unit,
    )
}

/// Whole metres without decimals.
fn trimmed(value: f64) -> String {
    if value.fract() == 0.0 { format!("{value:.0}") } else { number(value) }
}
