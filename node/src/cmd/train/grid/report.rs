//! A grid as table, picture and JSON.

use anyhow::Result;
use serde_json::json;

use super::super::Args;
use super::rows::{GridName, Row};
use super::{Figures, Found};
use crate::output::atomic::write_bytes;

/// Name, digits after the point, and value of the columns of a table.
type Column = (&'static str, usize, fn(&Figures) -> Option<f64>);

/// Columns of every table.
const ERRORS: [Column; 5] = [
    ("PSNR, dB", 2, |f| f.errors.psnr),
    ("depth error", 3, |f| f.errors.depth_relative),
    ("depth RMSE, m", 2, |f| f.errors.depth_rmse),
    ("EPE3D, m/s", 3, |f| f.errors.epe3d),
    ("EPE3D of movers, m/s", 3, |f| f.errors.epe3d_moving),
];

/// Columns of networks of different sizes.
const COSTS: [Column; 3] = [
    ("parameters, million", 2, |f| Some(f.parameters as f64 / 1e6)),
    ("tokens", 0, |f| f.cost.map(|c| c.tokens as f64)),
    ("step, ms", 0, |f| f.cost.map(|c| c.step_ms)),
];

fn columns(name: GridName) -> Vec<Column> {
    let costs: &[Column] = if name == GridName::Sizes { &COSTS } else { &[] };
    costs.iter().chain(&ERRORS).copied().collect()
}

/// What was trained, in one line.
fn what(args: &Args) -> String {
    let weights: Vec<String> = args.weights.iter().map(|w| w.display().to_string()).collect();
    let from = match weights.is_empty() {
        true => format!("new {} networks", args.preset_name()),
        false => format!("from {} weights", weights.join(" and ")),
    };
    format!(
        "{from}, {} steps of {} clips, {} cameras, recipe {}, data seed {}; {} validation drives",
        args.steps,
        args.batch,
        args.cameras,
        args.recipe.name(),
        args.seed,
        args.validate_drives
    )
}

/// Markdown.
pub fn table(args: &Args, name: GridName, results: &[(Row, Found)]) -> String {
    let columns = columns(name);
    let names: Vec<&str> = columns.iter().map(|c| c.0).collect();
    let what = what(args);
    let mut text = format!(
        "# Grid: {}\n\n{what}.\n\n| | | {} |\n|---|---|{}\n",
        name.name(),
        names.join(" | "),
        "---|".repeat(names.len())
    );
    for (row, found) in results {
        let cells: Vec<String> = match found {
            Found::Figures(f) => {
                columns.iter().map(|(_, digits, get)| get(f).map_or("-".into(), |x| format!("{x:.digits$}"))).collect()
            }
            Found::Ended(why) => {
                std::iter::once(why.clone()).chain(columns.iter().skip(1).map(|_| String::new())).collect()
            }
        };
        text += &format!("| {} | {} | {} |\n", row.group, row.label, cells.join(" | "));
    }
    text
}

/// All three files.
pub fn write(args: &Args, name: GridName, results: &[(Row, Found)]) -> Result<()> {
    let one = |(row, found): &(Row, Found)| {
        let (figures, ended) = match found {
            Found::Figures(f) => {
                let (tokens, step_ms) = f.cost.map(|c| (c.tokens, c.step_ms)).unzip();
                (
                    json!({"errors": f.errors, "parameters": f.parameters, "tokens": tokens, "step_ms": step_ms}),
                    json!(null),
                )
            }
            Found::Ended(why) => (json!(null), json!(why)),
        };
        json!({"group": row.group, "setting": row.label, "timesteps_seen": row.seen, "figures": figures, "ended": ended})
    };
    let report = json!({"grid": name.name(), "what": what(args), "rows": results.iter().map(one).collect::<Vec<_>>()});
    let put =
        |ending: &str, text: String| write_bytes(&args.out.join(format!("{}.{ending}", name.name())), text.as_bytes());
    put("json", serde_json::to_string_pretty(&report)? + "\n")?;
    put("md", table(args, name, results))?;
    put("svg", picture(results))?;
    Ok(())
}

/// Sizes in SVG units.
const ROW: f64 = 18.0;
const HEAD: f64 = 26.0;
const LABEL: f64 = 190.0;
const BAR: f64 = 240.0;
const GAP: f64 = 90.0;

/// The figures drawn, with their colours.
const DRAWN: [(Column, &str); 2] = [(ERRORS[0], "#1f77b4"), (ERRORS[4], "#d95f02")];

/// Bars of every row, one column per figure drawn.
fn picture(results: &[(Row, Found)]) -> String {
    let value = |found: &Found, column: &Column| match found {
        Found::Figures(f) => column.2(f).filter(|x| x.is_finite()),
        Found::Ended(_) => None,
    };
    let (mut y, mut group, mut body) = (HEAD, "", String::new());
    for (column, (drawn, _)) in DRAWN.iter().enumerate() {
        let x = LABEL + column as f64 * (BAR + GAP);
        let name = drawn.0;
        body += &format!("<text x=\"{x}\" y=\"16\" font-weight=\"bold\">{name}</text>\n");
    }
    for (row, found) in results {
        if row.group != group {
            group = row.group;
            y += ROW;
            body += &format!("<text x=\"6\" y=\"{y:.0}\" font-weight=\"bold\">{group}</text>\n");
        }
        y += ROW;
        body += &format!("<text x=\"{}\" y=\"{y:.0}\" text-anchor=\"end\">{}</text>\n", LABEL - 8.0, row.label);
        for (column, (drawn, color)) in DRAWN.iter().enumerate() {
            let most = results.iter().filter_map(|(_, f)| value(f, drawn)).fold(0.0, f64::max);
            let x = LABEL + column as f64 * (BAR + GAP);
            match value(found, drawn) {
                Some(found) if most > 0.0 => {
                    let width = BAR * (found / most).max(0.0);
                    body += &format!(
                        "<rect x=\"{x}\" y=\"{:.0}\" width=\"{width:.1}\" height=\"12\" fill=\"{color}\"/>\n<text x=\"{:.1}\" y=\"{y:.0}\">{found:.2}</text>\n",
                        y - 10.0,
                        x + width + 5.0
                    );
                }
                _ => body += &format!("<text x=\"{x}\" y=\"{y:.0}\" fill=\"#b22222\">ended, not finite</text>\n"),
            }
        }
    }
    let (width, height) = (LABEL + DRAWN.len() as f64 * (BAR + GAP), y + HEAD);
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" font-family=\"sans-serif\" font-size=\"12\">\n\
         <rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n{body}</svg>\n"
    )
}

#[cfg(test)]
mod tests {
    use storm_model::train::Validation;

    use super::*;

    #[test]
    fn tables_and_pictures_hold_every_row_and_no_nonsense() {
        let errors = Validation { epe3d_moving: Some(3.25), psnr: Some(21.5), ..Validation::default() };
        let figures = Figures { errors, parameters: 2_940_000, cost: None };
        let results: Vec<(Row, Found)> = GridName::Ablations
            .rows()
            .into_iter()
            .enumerate()
            .map(|(k, row)| {
                (row, if k == 0 { Found::Ended("step 3: loss rgb".into()) } else { Found::Figures(Box::new(figures)) })
            })
            .collect();
        let svg = picture(&results);
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        assert_eq!(svg.matches("<rect").count(), 1 + 2 * 20);
        assert_eq!(svg.matches("ended").count(), 2);
        let all_ended: Vec<_> = results.iter().map(|(r, _)| (r.clone(), results[0].1.clone())).collect();
        assert!(!picture(&all_ended).contains("NaN"));
    }
}
