//! The figures as a table: figures down, methods across.

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

/// For the terminal, aligned.
pub(super) fn text(methods: &[(&str, &Figures)], spread: Option<&Figures>) -> String {
    let rows = rows(methods, spread);
    let columns = rows.first().map_or(0, Vec::len);
    let width = |c: usize| rows.iter().map(|row| row[c].len()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let mut out = String::new();
    for row in &rows {
        for (c, (cell, width)) in row.iter().zip(&widths).enumerate() {
            out += &if c == 0 { format!("{cell:width$}") } else { format!("  {cell:>width$}") };
        }
        out.push('\n');
    }
    out
}

/// For documents.
pub(super) fn markdown(methods: &[(&str, &Figures)], spread: Option<&Figures>) -> String {
    let mut out = String::new();
    for (i, row) in rows(methods, spread).iter().enumerate() {
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
}
