//! The figures as tables: the main one (figures down, methods across), and where the error is.

use storm_model::metrics::movers::MoverKind;

use crate::engine::evaluate::{BinFigures, BreakdownFigures};
use crate::engine::figures::Figures;

/// Digits behind the point, by unit.
fn number(value: Option<f64>, unit: &str) -> String {
    match (value, unit) {
        (None, _) => "-".into(),
        (Some(x), "dB" | "m") => format!("{x:.2}"),
        (Some(x), "ms") => format!("{x:.0}"),
        (Some(x), _) => format!("{x:.3}"),
    }
}

/// Column of the first method's standard errors.
const SPREAD: &str = "+-";

/// Figures in rows with their unit, methods in columns; figures that no method has are left out. Behind the first method its standard
/// errors over the clips.
fn rows(methods: &[(&str, &Figures)], spread: Option<&Figures>) -> Vec<Vec<String>> {
    let mut names: Vec<String> = methods.iter().map(|(name, _)| name.to_string()).collect();
    if spread.is_some() {
        names.insert(1.min(names.len()), SPREAD.into());
    }
    let mut out = vec![std::iter::once(String::new()).chain(names).collect()];
    let spread = spread.map(Figures::rows);
    let all: Vec<_> = methods.iter().map(|(_, figures)| figures.rows()).collect();
    let count = all.first().map_or(0, |rows| rows.len());
    for k in 0..count {
        if all.iter().all(|rows| rows[k].2.is_none()) {
            continue;
        }
        let (name, unit, _) = all[0][k];
        let label = if unit.is_empty() { name.to_string() } else { format!("{name}, {unit}") };
        let mut cells: Vec<String> = all.iter().map(|rows| number(rows[k].2, unit)).collect();
        if let Some(spread) = &spread {
            cells.insert(1.min(cells.len()), number(spread[k].2, unit));
        }
        out.push(std::iter::once(label).chain(cells).collect());
    }
    out
}

/// What would mend the images, and what is wrong with the motion: figures down, methods across.
fn causes(methods: &[(&str, &BreakdownFigures)]) -> Vec<Vec<String>> {
    let mut out = vec![std::iter::once(String::new()).chain(methods.iter().map(|(name, _)| (*name).into())).collect()];
    let columns: Vec<Vec<(String, &str, Option<f64>)>> = methods.iter().map(|(_, b)| one_cause(b)).collect();
    for k in 0..columns.first().map_or(0, Vec::len) {
        if columns.iter().any(|column| column[k].2.is_some()) {
            let (name, unit, _) = &columns[0][k];
            let label = if unit.is_empty() { name.clone() } else { format!("{name}, {unit}") };
            out.push(std::iter::once(label).chain(columns.iter().map(|c| number(c[k].2, unit))).collect());
        }
    }
    out
}

fn one_cause(b: &BreakdownFigures) -> Vec<(String, &'static str, Option<f64>)> {
    let mut rows: Vec<(String, &str, Option<f64>)> =
        b.mends.rows().into_iter().map(|(name, x)| (name.into(), "dB", x)).collect();
    rows.push(("speed error of movers".into(), "m/s", b.movers.speed_error));
    rows.push(("direction error of movers".into(), "rad", b.movers.direction_error));
    for kind in MoverKind::ALL {
        let share = b.kinds.iter().find(|share| share.kind == kind.name());
        let name = kind.name().replace('_', " ");
        rows.push((format!("movers, {name}: pixels"), "", share.map(|share| share.pixels)));
        rows.push((format!("movers, {name}: error"), "", share.and_then(|share| share.error)));
    }
    rows.push(("bases from their start, largest".into(), "m/s", b.bases.from_fan));
    rows.push(("bases between clips".into(), "m/s", b.bases.between_clips));
    rows
}

/// A column of the table by distance and class: title, unit, value.
type BinColumn = (&'static str, &'static str, fn(&BinFigures) -> Option<f64>);

const BIN_COLUMNS: [BinColumn; 7] = [
    ("movers' pixels", "", |b| b.movers_share),
    ("movers' error", "", |b| b.error_share),
    ("EPE3D moving, m/s", "m/s", |b| b.epe3d_moving),
    ("EPE3D still, m/s", "m/s", |b| b.epe3d_still),
    ("missed", "", |b| b.missed_share),
    ("depth error", "", |b| b.depth_relative),
    ("PSNR, dB", "dB", |b| b.psnr),
];

/// Errors of one method by distance and class.
fn bins(method: &str, b: &BreakdownFigures) -> Vec<Vec<String>> {
    let titles = BIN_COLUMNS.iter().map(|(title, ..)| (*title).to_string());
    let mut out = vec![std::iter::once(method.to_string()).chain(titles).collect()];
    for bin in b.by_distance.iter().chain(&b.by_class) {
        let cells = BIN_COLUMNS.iter().map(|(_, unit, value)| number(value(bin), unit));
        out.push(std::iter::once(bin.name.clone()).chain(cells).collect());
    }
    out
}

/// Where the error is: of all methods what would mend it, of the first one by distance and class.
pub(super) fn where_text(methods: &[(&str, &BreakdownFigures)]) -> String {
    tables(methods).iter().map(|rows| format!("\n{}", aligned(rows))).collect()
}

/// The same for documents.
pub(super) fn where_markdown(methods: &[(&str, &BreakdownFigures)]) -> String {
    tables(methods).iter().map(|rows| format!("\n{}", piped(rows))).collect()
}

/// Those that have any row.
fn tables(methods: &[(&str, &BreakdownFigures)]) -> Vec<Vec<Vec<String>>> {
    let first = methods.first().map(|(name, b)| bins(name, b));
    std::iter::once(causes(methods)).chain(first).filter(|rows| rows.len() > 1).collect()
}

/// For the terminal, aligned.
pub(super) fn text(methods: &[(&str, &Figures)], spread: Option<&Figures>) -> String {
    aligned(&rows(methods, spread))
}

fn aligned(rows: &[Vec<String>]) -> String {
    let columns = rows.first().map_or(0, Vec::len);
    let width = |c: usize| rows.iter().map(|row| row[c].len()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let mut out = String::new();
    for row in rows {
        for (c, (cell, width)) in row.iter().zip(&widths).enumerate() {
            out += &if c == 0 { format!("{cell:width$}") } else { format!("  {cell:>width$}") };
        }
        out.push('\n');
    }
    out
}

/// For documents.
pub(super) fn markdown(methods: &[(&str, &Figures)], spread: Option<&Figures>) -> String {
    piped(&rows(methods, spread))
}

fn piped(rows: &[Vec<String>]) -> String {
    let mut out = String::new();
    for (i, row) in rows.iter().enumerate() {
        out += &format!("| {} |\n", row.join(" | "));
        if i == 0 {
            out += &format!("|---|{}\n", "---:|".repeat(row.len() - 1));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_aligned_and_empty_rows_left_out() {
        let a = Figures { psnr: Some(21.456), ms: Some(1234.5), ..Figures::default() };
        let b = Figures { acc5: Some(0.5), ..Figures::default() };
        let methods = [("storm", &a), ("nearest_context", &b)];
        let spread = Figures { psnr: Some(0.25), ..Figures::default() };
        for (spread, columns) in [(None, 3), (Some(&spread), 4)] {
            let table = text(&methods, spread);
            let lines: Vec<&str> = table.lines().collect();
            assert_eq!(lines.len(), 4, "{table}");
            assert!(lines.iter().all(|l| l.len() == lines[0].len()), "{table}");
            let psnr: Vec<&str> = lines[1].split_whitespace().collect();
            let expected: &[&str] = if columns == 3 { &["21.46", "-"] } else { &["21.46", "0.25", "-"] };
            assert_eq!(psnr[2..], *expected, "{table}");
            assert!(lines[0].ends_with("nearest_context") && lines[0].contains(SPREAD) == (columns == 4), "{table}");
            let markdown = markdown(&methods, spread);
            assert!(markdown.lines().all(|l| l.matches('|').count() == columns + 1), "{markdown}");
        }
    }

    #[test]
    fn what_is_wrong_stands_in_tables_of_its_own() {
        let bin = BinFigures {
            name: "0-10 m".into(),
            movers_share: Some(0.5),
            error_share: Some(0.6),
            epe3d_moving: Some(3.8),
            epe3d_still: None,
            missed_share: Some(0.24),
            depth_relative: Some(0.1),
            psnr: Some(21.256),
        };
        let mut first = BreakdownFigures { by_distance: vec![bin], ..BreakdownFigures::default() };
        first.mends.color = Some(0.456);
        first.bases.from_fan = Some(0.2);
        let second = BreakdownFigures::default();
        let methods = [("storm", &first), ("static", &second)];
        let markdown = where_markdown(&methods);
        let lines: Vec<&str> = markdown.lines().filter(|l| !l.is_empty()).collect();
        assert!(lines.contains(&"| gain: colour, dB | 0.46 | - |"), "{markdown}");
        assert!(lines.contains(&"| bases from their start, largest, m/s | 0.200 | - |"), "{markdown}");
        assert!(lines.contains(&"| 0-10 m | 0.500 | 0.600 | 3.800 | - | 0.240 | 0.100 | 21.26 |"), "{markdown}");
        assert_eq!(where_text(&methods).lines().filter(|l| !l.is_empty()).count(), lines.len() - 2);
        assert_eq!(where_text(&[("static", &second)]), "");
    }
}
