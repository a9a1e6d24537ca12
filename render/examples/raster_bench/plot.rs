//! Cost over the number of Gaussians, as a picture.

use std::fmt::Write as _;

/// A line of points `(Gaussians, milliseconds)`.
pub struct Line {
    pub name: String,
    pub points: Vec<(f64, f64)>,
}

impl Line {
    /// The exponent `p` of the best fit `ms = a n^p`: 1 is linear, less is cheaper than that.
    pub fn exponent(&self) -> f64 {
        let logs: Vec<(f64, f64)> = self.points.iter().map(|(n, ms)| (n.ln(), ms.ln())).collect();
        let mean = |f: fn(&(f64, f64)) -> f64| logs.iter().map(f).sum::<f64>() / logs.len() as f64;
        let (x, y) = (mean(|p| p.0), mean(|p| p.1));
        let covariance: f64 = logs.iter().map(|p| (p.0 - x) * (p.1 - y)).sum();
        covariance / logs.iter().map(|p| (p.0 - x).powi(2)).sum::<f64>()
    }
}

const SIZE: (f64, f64) = (720.0, 440.0);
/// Left, top, right, bottom.
const MARGINS: (f64, f64, f64, f64) = (70.0, 46.0, 20.0, 56.0);
const COLORS: [&str; 4] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7"];

/// Both axes logarithmic, with a dashed line of linear cost through each line's largest point.
pub fn svg(title: &str, lines: &[Line]) -> String {
    let points = || lines.iter().flat_map(|line| &line.points);
    let range = |f: fn(&(f64, f64)) -> f64| {
        let low = points().map(f).fold(f64::INFINITY, f64::min);
        let high = points().map(f).fold(f64::NEG_INFINITY, f64::max);
        (low.log10().floor(), high.log10().ceil())
    };
    let (x_range, y_range) = (range(|p| p.0), range(|p| p.1));
    let (left, top, right, bottom) = MARGINS;
    let scale = |v: f64, (low, high): (f64, f64)| (v.log10() - low) / (high - low).max(1.0);
    let x = |n: f64| left + scale(n, x_range) * (SIZE.0 - left - right);
    let y = |ms: f64| SIZE.1 - bottom - scale(ms, y_range) * (SIZE.1 - top - bottom);
    let mut s = String::new();
    // Writing to a string cannot fail.
    let _ = writeln!(
        s,
        r##"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {0} {1}" width="{0}" height="{1}" font-family="sans-serif" font-size="13"><rect width="{0}" height="{1}" fill="#ffffff"/><text x="{left}" y="24" font-size="15">{title}</text>"##,
        SIZE.0, SIZE.1
    );
    let decade = |k: i32| 10f64.powi(k);
    for k in x_range.0 as i32..=x_range.1 as i32 {
        let at = x(decade(k));
        let label = match k {
            6.. => format!("{} M", 10u64.pow(k as u32 - 6)),
            3.. => format!("{} k", 10u64.pow(k as u32 - 3)),
            _ => format!("{}", decade(k)),
        };
        let (from, to) = (top, SIZE.1 - bottom);
        let _ = writeln!(
            s,
            r##"<line x1="{at:.1}" y1="{from}" x2="{at:.1}" y2="{to}" stroke="#dddddd"/><text x="{at:.1}" y="{:.1}" text-anchor="middle">{label}</text>"##,
            to + 18.0
        );
    }
    for k in y_range.0 as i32..=y_range.1 as i32 {
        let (at, to) = (y(decade(k)), SIZE.0 - right);
        let _ = writeln!(
            s,
            r##"<line x1="{left}" y1="{at:.1}" x2="{to}" y2="{at:.1}" stroke="#dddddd"/><text x="{:.1}" y="{:.1}" text-anchor="end">{} ms</text>"##,
            left - 8.0,
            at + 4.0,
            decade(k)
        );
    }
    let _ = writeln!(
        s,
        r##"<text x="{:.1}" y="{:.1}" text-anchor="middle">visible Gaussians</text>"##,
        0.5 * (left + SIZE.0 - right),
        SIZE.1 - 14.0
    );
    for (index, line) in lines.iter().enumerate() {
        let color = COLORS[index % COLORS.len()];
        let path: Vec<String> = line.points.iter().map(|&(n, ms)| format!("{:.1},{:.1}", x(n), y(ms))).collect();
        let _ =
            writeln!(s, r##"<polyline points="{}" fill="none" stroke="{color}" stroke-width="2.5"/>"##, path.join(" "));
        for &(n, ms) in &line.points {
            let _ = writeln!(s, r##"<circle cx="{:.1}" cy="{:.1}" r="3.5" fill="{color}"/>"##, x(n), y(ms));
        }
        if let (Some(first), Some(last)) = (line.points.first(), line.points.last()) {
            // As far down as the picture goes.
            let from = first.0.max(last.0 * decade(y_range.0 as i32) / last.1);
            let _ = writeln!(
                s,
                r##"<line x1="{:.1}" y1="{:.1}" x2="{:.1}" y2="{:.1}" stroke="{color}" stroke-dasharray="4 4"/>"##,
                x(from),
                y(last.1 * from / last.0),
                x(last.0),
                y(last.1)
            );
        }
        let row = top + 16.0 + 18.0 * index as f64;
        let _ = writeln!(
            s,
            r##"<rect x="{:.1}" y="{:.1}" width="14" height="4" fill="{color}"/><text x="{:.1}" y="{row:.1}">{}, ms ~ n^{:.2}</text>"##,
            left + 12.0,
            row - 6.0,
            left + 32.0,
            line.name,
            line.exponent()
        );
    }
    let row = top + 16.0 + 18.0 * lines.len() as f64;
    let _ = writeln!(s, r##"<text x="{:.1}" y="{row:.1}" fill="#555555">dashed: linear</text></svg>"##, left + 32.0);
    s
}
