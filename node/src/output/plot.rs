//! Pictures of numbers as SVG: panels one below the other, each with lines or single marks over two axes, linear or logarithmic.

use std::fmt::Write as _;

/// Sizes in SVG units (pixels at full width).
const WIDTH: f64 = 900.0;
const PANEL_HEIGHT: f64 = 240.0;
const TALL_PANEL_HEIGHT: f64 = 400.0;
const LEFT: f64 = 70.0;
const TOP: f64 = 30.0;
const BOTTOM: f64 = 46.0;
/// Room for names: of lines, and of numbered marks.
const LINE_NAMES: f64 = 130.0;
const MARK_NAMES: f64 = 260.0;
const NAME_ROW: f64 = 14.0;
/// Smaller values are drawn as this where an axis is logarithmic.
const LOG_FLOOR: f64 = 1e-9;
/// Air around what is drawn, as a part of its range.
const AIR: f64 = 0.04;

/// Ten colours that stay apart for colour-blind readers too; further lines repeat them dashed.
const COLORS: [&str; 10] =
    ["#1f77b4", "#d95f02", "#1b9e77", "#7570b3", "#e7298a", "#66a61e", "#a6761d", "#444444", "#17becf", "#b22222"];

/// One axis.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Axis {
    /// What it measures, with unit.
    pub label: String,
    /// Whether it is logarithmic.
    pub log: bool,
}

impl Axis {
    /// A linear one.
    pub fn linear(label: &str) -> Self {
        Self { label: label.into(), log: false }
    }

    /// A logarithmic one.
    pub fn log(label: &str) -> Self {
        Self { label: label.into(), log: true }
    }

    fn scaled(&self, x: f64) -> f64 {
        if self.log { x.max(LOG_FLOOR).log10() } else { x }
    }
}

/// How a series is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Drawn {
    /// A line.
    Line,
    /// A dashed line.
    Dashed,
    /// A mark for each point, numbered like its name.
    Mark,
    /// The same, large: the one to look at first.
    BoldMark,
}

/// Points `(x, y)` under one name.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// For the names beside the panel.
    pub name: String,
    /// Points; what is not finite is left out.
    pub points: Vec<(f64, f64)>,
    /// How.
    pub drawn: Drawn,
}

/// One panel.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel {
    /// Above it.
    pub title: String,
    /// Across.
    pub x: Axis,
    /// Up.
    pub y: Axis,
    /// What is in it.
    pub series: Vec<Series>,
}

/// The panels one below the other, on white.
pub fn svg(panels: &[Panel]) -> String {
    let mut top = 0.0;
    let mut body = String::new();
    for panel in panels {
        body += &panel.draw(top);
        top += panel.height();
    }
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {top}\" font-family=\"sans-serif\" font-size=\"12\">\n\
         <rect width=\"{WIDTH}\" height=\"{top}\" fill=\"white\"/>\n{body}</svg>\n"
    )
}

/// Text that may stand between tags.
fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

/// Lowest and highest, with air; something to draw in where there is nothing or one value.
fn range(values: impl Iterator<Item = f64>, air: f64) -> (f64, f64) {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
    match (low.is_finite() && high.is_finite(), high > low) {
        (false, _) => (0.0, 1.0),
        (true, false) => (low - 0.5, high + 0.5),
        (true, true) => (low - air * (high - low), high + air * (high - low)),
    }
}

/// Places of an axis that get a label.
fn ticks(axis: &Axis, (low, high): (f64, f64)) -> Vec<f64> {
    if axis.log && high - low >= 1.0 {
        let decades: Vec<f64> = (low.ceil() as i32..=high.floor() as i32).map(f64::from).collect();
        if decades.len() >= 2 {
            return decades;
        }
    }
    (0..5).map(|k| low + (high - low) * f64::from(k) / 4.0).collect()
}

fn label(axis: &Axis, at: f64) -> String {
    let x = if axis.log { 10f64.powf(at) } else { at };
    match x.abs() {
        a if a >= 1e6 || (a > 0.0 && a < 1e-3) => format!("{x:.1e}"),
        a if a >= 100.0 => format!("{x:.0}"),
        a if a >= 10.0 => format!("{x:.1}"),
        _ => format!("{x:.3}"),
    }
}

impl Panel {
    fn marks(&self) -> bool {
        self.series.iter().any(|s| matches!(s.drawn, Drawn::Mark | Drawn::BoldMark))
    }

    fn height(&self) -> f64 {
        let names = TOP + BOTTOM + NAME_ROW * self.series.len() as f64;
        if self.marks() { TALL_PANEL_HEIGHT.max(names) } else { PANEL_HEIGHT.max(names) }
    }

    fn draw(&self, top: f64) -> String {
        let right = if self.marks() { MARK_NAMES } else { LINE_NAMES };
        let (w, h) = (WIDTH - LEFT - right, self.height() - TOP - BOTTOM);
        let scaled = |&(x, y): &(f64, f64)| {
            let p = (self.x.scaled(x), self.y.scaled(y));
            (x.is_finite() && y.is_finite()).then_some(p)
        };
        let series: Vec<Vec<(f64, f64)>> =
            self.series.iter().map(|s| s.points.iter().filter_map(scaled).collect()).collect();
        let air = if self.marks() { AIR } else { 0.0 };
        let all = || series.iter().flatten();
        let (x_range, y_range) = (range(all().map(|p| p.0), air), range(all().map(|p| p.1), air));
        let px = |x: f64| LEFT + (x - x_range.0) / (x_range.1 - x_range.0) * w;
        let py = |y: f64| top + TOP + (1.0 - (y - y_range.0) / (y_range.1 - y_range.0)) * h;
        let mut svg = String::new();
        // Writing into a string cannot fail.
        let _ = writeln!(
            svg,
            "<text x=\"{LEFT}\" y=\"{}\" font-weight=\"bold\">{}</text>\n\
             <rect x=\"{LEFT}\" y=\"{}\" width=\"{w}\" height=\"{h}\" fill=\"none\" stroke=\"#999\"/>",
            top + 20.0,
            escape(&self.title),
            top + TOP
        );
        for tick in ticks(&self.y, y_range) {
            let at = py(tick);
            let _ = writeln!(
                svg,
                "<line x1=\"{LEFT}\" x2=\"{}\" y1=\"{at:.1}\" y2=\"{at:.1}\" stroke=\"#ddd\"/>\
                 <text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                LEFT + w,
                LEFT - 6.0,
                at + 4.0,
                label(&self.y, tick)
            );
        }
        let bottom = top + TOP + h;
        for tick in ticks(&self.x, x_range) {
            let at = px(tick);
            let _ = writeln!(
                svg,
                "<line x1=\"{at:.1}\" x2=\"{at:.1}\" y1=\"{}\" y2=\"{bottom}\" stroke=\"#eee\"/>\
                 <text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
                top + TOP,
                bottom + 15.0,
                label(&self.x, tick)
            );
        }
        let _ = writeln!(
            svg,
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\" fill=\"#555\">{}{}</text>",
            LEFT + 0.5 * w,
            bottom + 31.0,
            escape(&self.x.label),
            if self.y.label.is_empty() { String::new() } else { format!("; up: {}", escape(&self.y.label)) }
        );
        for (k, (s, points)) in self.series.iter().zip(&series).enumerate() {
            let color = COLORS[k % COLORS.len()];
            let at: Vec<(f64, f64)> = points.iter().map(|p| (px(p.0), py(p.1))).collect();
            match s.drawn {
                Drawn::Line | Drawn::Dashed => {
                    let dashed = s.drawn == Drawn::Dashed || k >= COLORS.len();
                    let dash = if dashed { " stroke-dasharray=\"5 4\"" } else { "" };
                    let path: Vec<String> = at.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
                    let _ = writeln!(
                        svg,
                        "<polyline points=\"{}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"1.5\"{dash}/>",
                        path.join(" ")
                    );
                }
                Drawn::Mark | Drawn::BoldMark => {
                    let bold = s.drawn == Drawn::BoldMark;
                    let (radius, edge) = if bold { (8.0, "black") } else { (5.0, "white") };
                    for (x, y) in at {
                        let _ = writeln!(
                            svg,
                            "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\" fill=\"{color}\" stroke=\"{edge}\" \
                             stroke-width=\"1.5\"/><text x=\"{:.1}\" y=\"{:.1}\" font-size=\"11\">{}</text>",
                            x + radius + 2.0,
                            y - 3.0,
                            k + 1
                        );
                    }
                }
            }
            let numbered = matches!(s.drawn, Drawn::Mark | Drawn::BoldMark);
            let number = if numbered { format!("{} ", k + 1) } else { String::new() };
            let weight = if s.drawn == Drawn::BoldMark { " font-weight=\"bold\"" } else { "" };
            let _ = writeln!(
                svg,
                "<text x=\"{}\" y=\"{:.1}\" fill=\"{color}\"{weight}>{number}{}</text>",
                LEFT + w + 8.0,
                top + TOP + 12.0 + NAME_ROW * k as f64,
                escape(&s.name)
            );
        }
        svg
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn series(points: &[(f64, f64)], drawn: Drawn) -> Series {
        Series { name: "a < b".into(), points: points.to_vec(), drawn }
    }

    #[test]
    fn whatever_comes_in_nothing_odd_is_drawn() {
        let odd = [(f64::NAN, 1.0), (1.0, f64::INFINITY), (0.0, -5.0), (10.0, 0.0), (1000.0, 3.0)];
        for points in [&odd[..], &[], &[(5.0, 5.0)]] {
            for drawn in [Drawn::Line, Drawn::Dashed, Drawn::Mark, Drawn::BoldMark] {
                let panel = Panel {
                    title: "p & q".into(),
                    x: Axis::log("ms"),
                    y: Axis::linear("dB"),
                    series: vec![series(points, drawn)],
                };
                let svg = svg(&[panel.clone(), panel]);
                assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
                assert!(svg.contains("a &lt; b") && svg.contains("p &amp; q"));
                assert_eq!(svg.matches("<svg").count(), 1);
            }
        }
    }

    #[test]
    fn a_logarithmic_axis_has_decades_and_places_them_evenly() {
        let axis = Axis::log("ms");
        assert_eq!(ticks(&axis, (0.9, 3.2)), [1.0, 2.0, 3.0]);
        assert_eq!(["10.0", "100", "1000"].map(String::from), [1.0, 2.0, 3.0].map(|t| label(&axis, t)));
        let panel = Panel {
            title: String::new(),
            x: Axis::log(""),
            y: Axis::linear(""),
            series: vec![series(&[(1.0, 0.0), (10.0, 1.0), (100.0, 2.0)], Drawn::Line)],
        };
        let svg = svg(&[panel]);
        let path = svg.split("points=\"").nth(1).and_then(|s| s.split('"').next()).unwrap();
        let x: Vec<f64> = path.split(' ').map(|p| p.split(',').next().unwrap().parse().unwrap()).collect();
        assert!((x[1] - x[0] - (x[2] - x[1])).abs() < 0.2, "{x:?}");
    }
}
