use super::*;

fn report() -> Report {
    let view = TopView::fit(&[[0.0; 3], [50.0, 20.0, 0.0]], &[], 300, 300);
    let panel = |title: &str| Panel {
        title: title.into(),
        caption: "m, 1 to 80".into(),
        picture: Picture::filled(8, 6, [1, 2, 3]),
    };
    Report {
        title: "drive <1>".into(),
        subtitle: "20 s & 3 cameras".into(),
        weights: WeightsState::Untrained,
        highlights: vec![("steps".into(), "12".into())],
        summary: vec![("bag".into(), "a\"b".into())],
        drops: vec![("late".into(), 0), ("no pose".into(), 3)],
        errors: Some(ErrorTable {
            methods: vec!["storm".into(), "static".into()],
            rows: vec![
                ErrorRow {
                    name: "PSNR".into(),
                    unit: "dB".into(),
                    higher_is_better: true,
                    values: vec![Some(25.5), Some(f64::NAN)],
                },
                ErrorRow {
                    name: "EPE".into(),
                    unit: "m/s".into(),
                    higher_is_better: false,
                    values: vec![Some(0.75), Some(0.5)],
                },
            ],
            note: "held-out frames".into(),
        }),
        steps: vec![ReportStep {
            index: 4,
            stamp_ns: 1_700_000_000_500_000_000,
            note: "9000 Gaussians".into(),
            cameras: vec![ReportCamera {
                name: "camera0".into(),
                panels: ["input", "rendered", "depth", "flow", "mask"].map(panel).to_vec(),
            }],
        }],
        top_view: Some(TopViewSection {
            picture: Picture::filled(view.width, view.height, [0; 3]),
            view,
            tracks: vec![
                ReportTrack { points: vec![[1.0, 1.0, 0.0], [9.0, 4.0, 0.0]], color: [255, 0, 16] },
                ReportTrack { points: vec![[f64::NAN; 3], [9.0, 4.0, 0.0]], color: [0; 3] },
            ],
            trajectory: vec![[0.0; 3], [50.0, 20.0, 0.0]],
            caption: "top".into(),
        }),
        timings: vec![
            StageTiming { name: "decode".into(), p50_ms: 2.0, p99_ms: 4.0 },
            StageTiming { name: "network".into(), p50_ms: 80.0, p99_ms: 100.0 },
        ],
        config_yaml: "a: <b>\n".into(),
        files: vec![ReportFile { name: "map.ply".into(), bytes: Some(1500), what: "the map".into() }],
    }
}

#[test]
fn the_page_stands_alone_and_escapes_what_it_shows() {
    let html = report().to_html().unwrap();
    for outside in ["http:", "https:", "src=\"/", "<script", "@import", "url(", "<link"] {
        assert!(!html.contains(outside), "the page refers to {outside}");
    }
    assert!(html.contains("default-src 'none'"));
    assert!(html.contains("drive &lt;1&gt;") && html.contains("20 s &amp; 3 cameras") && html.contains("a: &lt;b&gt;"));
    assert_eq!(html.matches("<img src=\"data:image/png;base64,").count(), 5);
    assert_eq!(html.matches("class=\"moving\"").count(), 1, "a track of one finite point is no line");
    assert!(!html.contains("NaN") && !html.contains("inf\""));
    assert_eq!(html, report().to_html().unwrap());
}

#[test]
fn tags_are_balanced() {
    let html = report().to_html().unwrap();
    for tag in ["main", "header", "section", "details", "figure", "table", "tr", "td", "svg", "g", "div", "nav", "span"]
    {
        let opened = html.matches(&format!("<{tag}>")).count() + html.matches(&format!("<{tag} ")).count();
        assert_eq!(opened, html.matches(&format!("</{tag}>")).count(), "<{tag}>");
    }
}

#[test]
fn untrained_weights_are_said_and_trained_ones_named() {
    let mut r = report();
    assert!(r.to_html().unwrap().contains("Untrained weights"));
    r.weights = WeightsState::Trained { name: "tiny-synth".into(), note: "procedural drives".into() };
    let html = r.to_html().unwrap();
    assert!(!html.contains("Untrained weights") && html.contains("tiny-synth"));
}

#[test]
fn the_best_figure_is_marked_by_its_direction_and_drops_are_counted() {
    let html = report().to_html().unwrap();
    assert!(html.contains("<td class=\"best\">25.50</td>"));
    assert!(html.contains("<td class=\"best\">0.5000</td>") && html.contains("<td>0.7500</td>"));
    assert!(html.contains("<div class=\"card bad\"><b>3</b><span>dropped</span></div>"));
    assert!(html.contains("no pose") && !html.contains(">late<"), "only reasons that happened are listed");
}

#[test]
fn an_empty_report_is_still_a_page() {
    let html = Report::default().to_html().unwrap();
    assert!(html.contains("</html>") && !html.contains("<h2>"));
}
