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

/// Figures in rows with their unit, methods in columns; figures that no method has are left out.
fn rows(methods: &[(&str, &Figures)]) -> Vec<Vec<String>> {
    let mut out =
        vec![std::iter::once(String::new()).chain(methods.iter().map(|(name, _)| name.to_string())).collect()];
    let all: Vec<_> = methods.iter().map(|(_, figures)| figures.rows()).collect();
    let count = all.first().map_or(0, |rows| rows.len());
    for k in 0..count {
        if all.iter().all(|rows| rows[k].2.is_none()) {
            continue;
        }
        let (name, unit, _) = all[0][k];
        let label = if unit.is_empty() { name.to_string() } else { format!("{name}, {unit}") };
        out.push(std::iter::once(label).chain(all.iter().map(|rows| number(rows[k].2, unit))).collect());
    }
    out
}

/// For the terminal, aligned.
pub(super) fn text(methods: &[(&str, &Figures)]) -> String {
    let rows = rows(methods);
    let columns = methods.len() + 1;
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
pub(super) fn markdown(methods: &[(&str, &Figures)]) -> String {
    let mut out = String::new();
    for (i, row) in rows(methods).iter().enumerate() {
        out += &format!("| {} |\n", row.join(" | "));
        if i == 0 {
            out += &format!("|---|{}\n", "---:|".repeat(methods.len()));
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
        let table = text(&methods);
        let lines: Vec<&str> = table.lines().collect();
        assert_eq!(lines.len(), 4, "{table}");
        assert!(lines.iter().all(|l| l.len() == lines[0].len()), "{table}");
        assert!(lines[1].starts_with("PSNR, dB") && lines[1].contains("21.46") && lines[1].ends_with('-'), "{table}");
        let markdown = markdown(&methods);
        assert!(markdown.lines().all(|l| l.matches('|').count() == 4), "{markdown}");
    }
}
