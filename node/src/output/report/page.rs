//! The page, section by section.

use super::chart::timing_chart;
use super::html::{duration, escape, file_size, number, relative_address, utc};
use super::top_view::top_view_figure;
use super::{ErrorTable, OutputError, Report, ReportCamera, ReportStep, WeightsState};
use crate::output::tum::seconds_text;

const STYLE: &str = include_str!("style.css");

/// The whole page.
pub(super) fn page(report: &Report) -> Result<String, OutputError> {
    let mut body = header(report);
    body.push_str(&banner(&report.weights));
    body.push_str(&highlights(report));
    body.push_str(&section("errors", "Error figures", &report.errors.as_ref().map(errors).unwrap_or_default()));
    body.push_str(&section("steps", "Step by step", &steps(report)?));
    if let Some(view) = &report.top_view {
        body.push_str(&section("map", "Map and trajectories", &top_view_figure(view)?));
    }
    let charts = if report.timings.is_empty() { String::new() } else { timings(report) };
    body.push_str(&section("timing", "Run time", &charts));
    body.push_str(&section("run", "The run", &run_tables(report)));
    body.push_str(&section("files", "Files", &files(report)));
    body.push_str(&section("config", "Configuration", &config(report)));
    Ok(format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; img-src data:; style-src \
         'unsafe-inline'\">\n<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n<title>{}</title>\n<style>\n{STYLE}</style>\n</head>\n\
         <body>\n<main>\n{body}</main>\n</body>\n</html>\n",
        escape(&report.title)
    ))
}

/// A titled section; nothing when it has no content.
fn section(id: &str, title: &str, content: &str) -> String {
    match content {
        "" => String::new(),
        _ => format!("<section id=\"{id}\">\n<h2>{title}</h2>\n{content}</section>\n"),
    }
}

fn header(report: &Report) -> String {
    let present = [
        ("errors", "Errors", report.errors.as_ref().is_some_and(|e| !e.rows.is_empty())),
        ("steps", "Steps", !report.steps.is_empty()),
        ("map", "Map", report.top_view.is_some()),
        ("timing", "Run time", !report.timings.is_empty()),
        ("files", "Files", !report.files.is_empty()),
        ("config", "Configuration", !report.config_yaml.is_empty()),
    ];
    let links: String = present
        .iter()
        .filter(|(_, _, there)| *there)
        .map(|(id, name, _)| format!("<a href=\"#{id}\">{name}</a>"))
        .collect();
    format!(
        "<header>\n<div><p class=\"kicker\">STORM run</p>\n<h1>{}</h1>\n<p class=\"subtitle\">{}</p></div>\n\
         <nav>{links}</nav>\n</header>\n",
        escape(&report.title),
        escape(&report.subtitle)
    )
}

fn banner(weights: &WeightsState) -> String {
    match weights {
        WeightsState::Untrained => "<div class=\"banner warning\" role=\"alert\"><strong>Untrained weights.</strong> \
             The network ran with random numbers: pictures and figures below show that data flows and how long it \
             takes, not what the scene looks like. Give trained weights with <code>--weights</code>.</div>\n"
            .into(),
        WeightsState::Trained { name, note } => {
            format!("<div class=\"banner\"><strong>Weights: {}.</strong> {}</div>\n", escape(name), escape(note))
        }
    }
}

fn highlights(report: &Report) -> String {
    let dropped: u64 = report.drops.iter().map(|d| d.1).sum();
    let mut cards: String = report
        .highlights
        .iter()
        .map(|(name, value)| {
            format!("<div class=\"card\"><b>{}</b><span>{}</span></div>\n", escape(value), escape(name))
        })
        .collect();
    if !report.drops.is_empty() {
        let class = if dropped > 0 { "card bad" } else { "card" };
        cards.push_str(&format!("<div class=\"{class}\"><b>{dropped}</b><span>dropped</span></div>\n"));
    }
    if cards.is_empty() { cards } else { format!("<div class=\"cards\">\n{cards}</div>\n") }
}

fn steps(report: &Report) -> Result<String, OutputError> {
    let mut out = String::new();
    for (shown, step) in report.steps.iter().enumerate() {
        out.push_str(&one_step(step, shown == 0)?);
    }
    Ok(out)
}

/// A step that can be folded away; only the first starts open when there are many pictures.
fn one_step(step: &ReportStep, first: bool) -> Result<String, OutputError> {
    let mut rows = String::new();
    for camera in &step.cameras {
        rows.push_str(&camera_row(camera)?);
    }
    Ok(format!(
        "<details class=\"step\" {}>\n<summary><b>Step {}</b><span title=\"{} s\">{}</span><span class=\"faint\">{}\
         </span></summary>\n{rows}</details>\n",
        if first || step.cameras.len() <= 3 { "open" } else { "" },
        step.index,
        seconds_text(step.stamp_ns),
        utc(step.stamp_ns),
        escape(&step.note)
    ))
}

fn camera_row(camera: &ReportCamera) -> Result<String, OutputError> {
    let mut figures = String::new();
    for panel in &camera.panels {
        let (title, p) = (escape(&panel.title), &panel.picture);
        // The hidden box inside the label lets a click (or tab and space) enlarge the picture without a script.
        figures.push_str(&format!(
            "<figure class=\"panel\"><label><input type=\"checkbox\" aria-label=\"enlarge {title}\"><img src=\"{}\" \
             width=\"{}\" height=\"{}\" alt=\"{title}, {}\"></label><figcaption><b>{title}</b> {}</figcaption></figure>\n",
            p.data_uri()?,
            p.width(),
            p.height(),
            escape(&camera.name),
            escape(&panel.caption)
        ));
    }
    Ok(format!(
        "<div class=\"camera\"><h3>{}</h3>\n<div class=\"panels\" style=\"--n:{}\">\n{figures}</div></div>\n",
        escape(&camera.name),
        camera.panels.len().max(1)
    ))
}

fn errors(table: &ErrorTable) -> String {
    if table.rows.is_empty() {
        return String::new();
    }
    let heads: String = table.methods.iter().map(|m| format!("<th>{}</th>", escape(m))).collect();
    let mut rows = String::new();
    for row in &table.rows {
        let finite = |v: &Option<f64>| v.filter(|v| v.is_finite());
        let better = |a: f64, b: f64| if row.higher_is_better { a.max(b) } else { a.min(b) };
        let best = row.values.iter().filter_map(finite).reduce(better);
        let cells: String = row
            .values
            .iter()
            .map(|v| match finite(v) {
                Some(x) if row.values.len() > 1 && best == Some(x) => format!("<td class=\"best\">{}</td>", number(x)),
                Some(x) => format!("<td>{}</td>", number(x)),
                None => "<td class=\"faint\">–</td>".into(),
            })
            .collect();
        let arrow = if row.higher_is_better { "↑" } else { "↓" };
        let unit = if row.unit.is_empty() { String::new() } else { format!(" {}", escape(&row.unit)) };
        rows.push_str(&format!(
            "<tr><th scope=\"row\">{} <span class=\"faint\">{arrow}{unit}</span></th>{cells}</tr>\n",
            escape(&row.name)
        ));
    }
    format!(
        "<div class=\"scroll\"><table class=\"figures\"><thead><tr><th></th>{heads}</tr></thead>\n<tbody>{rows}</tbody>\
         </table></div>\n<p class=\"faint\">{}</p>\n",
        escape(&table.note)
    )
}

fn timings(report: &Report) -> String {
    let total: f64 = report.timings.iter().map(|t| t.p50_ms).filter(|v| v.is_finite()).sum();
    format!(
        "{}<p class=\"faint\"><i class=\"key p50\"></i> median · <i class=\"key p99\"></i> 99th percentile. \
         Sum of the medians: {}.</p>\n",
        timing_chart(&report.timings),
        duration(total)
    )
}

fn pairs_table<'a>(rows: impl Iterator<Item = (&'a str, String)>) -> String {
    let rows: String = rows
        .map(|(name, value)| format!("<tr><th scope=\"row\">{}</th><td>{}</td></tr>\n", escape(name), escape(&value)))
        .collect();
    if rows.is_empty() { rows } else { format!("<table class=\"pairs\"><tbody>{rows}</tbody></table>\n") }
}

fn run_tables(report: &Report) -> String {
    let facts = pairs_table(report.summary.iter().map(|(n, v)| (n.as_str(), v.clone())));
    if report.drops.is_empty() {
        return facts;
    }
    let lost: Vec<_> = report.drops.iter().filter(|d| d.1 > 0).map(|d| (d.0.as_str(), d.1.to_string())).collect();
    let drops = if lost.is_empty() {
        "<p>Nothing was dropped.</p>\n".to_owned()
    } else {
        format!("<h3>Dropped, by reason</h3>\n{}", pairs_table(lost.into_iter()))
    };
    format!("{facts}{drops}")
}

fn files(report: &Report) -> String {
    let rows: String = report
        .files
        .iter()
        .map(|f| {
            format!(
                "<tr><th scope=\"row\"><a href=\"{}\">{}</a></th><td class=\"size\">{}</td><td>{}</td></tr>\n",
                relative_address(&f.name),
                escape(&f.name),
                f.bytes.map(file_size).unwrap_or_default(),
                escape(&f.what)
            )
        })
        .collect();
    if rows.is_empty() { rows } else { format!("<table class=\"pairs\"><tbody>{rows}</tbody></table>\n") }
}

fn config(report: &Report) -> String {
    match report.config_yaml.as_str() {
        "" => String::new(),
        yaml => format!("<details><summary>config.yaml as resolved</summary><pre>{}</pre></details>\n", escape(yaml)),
    }
}
