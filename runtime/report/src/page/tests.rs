//! Pages of runs that went right, and of runs that went wrong in every way they can.

use clap::ValueEnum as _;
use std::collections::BTreeMap;

use hil_account::network::network_series_name;

use super::read::{Found, Manifest, Material};
use super::series::{Series, parse};
use super::{FigureFile, Format, PAGE_BYTES_MAX, figure_files, page_of, render, write};
use crate::network::TimelineSubject;
use crate::summary::{Fact, RunSummary};
use crate::terminal::Style;
use crate::tests::sample::{awkward, empty, full};
use hil_present::units::JOINT;

const HOSTILE: &str = "</script><script>alert(1)</script>\"'><img src=x onerror=alert(1)>&amp;]]>";

fn material(summary: RunSummary) -> Material {
    Material {
        folder: "swing".to_owned(),
        found: Found::Ended(Box::new(summary)),
        series: Vec::new(),
        problems: Vec::new(),
    }
}

fn html(material: &Material) -> String {
    render(std::slice::from_ref(material), None, Format::Html, None).unwrap()
}

/// Every element that begins ends, in order; attributes are quoted, and no text has a bare `<`.
fn assert_well_formed(page: &str) {
    const VOID: [&str; 3] = ["meta", "link", "!doctype"];
    let mut open: Vec<String> = Vec::new();
    let mut rest = page;
    while let Some(at) = rest.find('<') {
        rest = &rest[at + 1..];
        if let Some(comment) = rest.strip_prefix("!--") {
            rest = &comment[comment.find("-->").expect("an open comment") + 3..];
            continue;
        }
        let end = rest.find('>').expect("an open tag");
        let tag = &rest[..end];
        rest = &rest[end + 1..];
        let name: String = tag
            .chars()
            .take_while(|c| !c.is_whitespace() && *c != '>')
            .collect();
        let name = name.trim_end_matches('/').to_ascii_lowercase();
        if let Some(name) = name.strip_prefix('/') {
            assert_eq!(open.pop().as_deref(), Some(name), "near {rest:.80}");
            continue;
        }
        assert!(
            name.starts_with(|c: char| c.is_ascii_alphabetic() || c == '!'),
            "<{tag}>"
        );
        assert_eq!(tag.matches('"').count() % 2, 0, "<{tag}>");
        let is_void = VOID.contains(&name.as_str()) || tag.ends_with('/');
        if name == "script" || name == "style" {
            let close = rest.find(&format!("</{name}")).expect("an open script");
            rest = &rest[close..];
        }
        if !is_void {
            open.push(name);
        }
    }
    assert!(open.is_empty(), "left open: {open:?}");
}

#[test]
fn a_full_page_is_well_formed_and_has_the_figures_of_the_summary() {
    let page = html(&material(full()));
    assert_well_formed(&page);
    let text = page.replace(JOINT, " ");
    for words in [
        "Did the network hurt the robot?",
        "swing-split",
        "arm/command",
        "Where each microsecond went",
        "Network and robot over time",
        "How long it took",
        "Losses in a row",
        "spin: core 1 is not isolated",
        "hil-runtime --topology deploy/topologies/split.toml --seed 42",
        "clocks not aligned",
        "effective sample",
    ] {
        assert!(text.contains(words), "{words}");
    }
    let summary = full();
    let account = summary.channels[0].account.as_ref().unwrap();
    let p99 = account.end_to_end.distribution.measured().unwrap().p99_ns;
    let p99 = hil_present::units::duration(p99);
    assert!(page.contains(&p99), "{p99}");
    assert!(!page.contains("NaN"));
}

#[test]
fn nothing_is_fetched_and_everything_is_seen_without_a_script() {
    let page = html(&material(full()));
    let addresses: Vec<&str> = page
        .match_indices("//")
        .filter_map(|(at, _)| page.get(at.saturating_sub(6)..at + 20))
        .collect();
    let fetched = [
        "src=",
        "@import",
        "url(http",
        "fetch(",
        "XMLHttpRequest",
        "https://",
    ];
    for word in fetched {
        assert!(!page.contains(word), "{word}: {addresses:?}");
    }
    // The name of the SVG vocabulary is no address that is fetched.
    let names = page.matches("http://").count();
    assert_eq!(
        names,
        page.matches("xmlns=\"http://www.w3.org/2000/svg\"").count()
    );
    let (before, _) = page.split_once("<script").unwrap();
    assert!(before.matches("<svg").count() >= 6);
    assert!(before.contains("Repeat this run"));
}

#[test]
fn hostile_texts_stay_texts() {
    let mut summary = full();
    summary.run.name = HOSTILE.to_owned();
    summary.run.repeat_command = HOSTILE.to_owned();
    summary.channels[0].name = HOSTILE.to_owned();
    summary.warnings.push(HOSTILE.to_owned());
    if let Some(network) = &mut summary.network {
        network.channels[0].channel = HOSTILE.to_owned();
        for row in &mut network.timeline.rows {
            match &mut row.subject {
                TimelineSubject::Channel { channel: name, .. }
                | TimelineSubject::Robot { label: name } => *name = HOSTILE.to_owned(),
            }
        }
    }
    for event in &mut summary.score_events.events {
        event.what = HOSTILE.to_owned();
    }
    let material = material(summary);
    let page = html(&material);
    assert_well_formed(&page);
    assert!(!page.contains("<img"), "escaped nowhere");
    assert_eq!(page.matches("<script").count(), 2);
    let markdown = render(std::slice::from_ref(&material), None, Format::Md, None).unwrap();
    // An indented line is code, and shown as it is.
    let prose = markdown.lines().filter(|line| !line.starts_with("    "));
    let markdown = prose.collect::<Vec<_>>().join("\n");
    assert!(
        !markdown.contains("<img") && !markdown.contains("<script"),
        "{markdown}"
    );
    for FigureFile { name, bytes } in figure_files(&[material], None, Format::Svg).unwrap() {
        let svg = String::from_utf8(bytes).unwrap();
        assert_well_formed(svg.trim_start_matches("<?xml version=\"1.0\" encoding=\"UTF-8\"?>"));
        assert!(
            name.bytes()
                .all(|b| b.is_ascii_alphanumeric() || b"-_".contains(&b)),
            "{name}"
        );
    }
}

#[test]
fn runs_that_went_wrong_get_pages_that_say_so() {
    let mut silent = full();
    silent.channels[0].account = None;
    silent.network = None;
    let manifest = Manifest {
        name: "<killed>".to_owned(),
        command_line: ["hil-runtime", "--set", "run.duration=\"1 s\""]
            .map(str::to_owned)
            .into(),
        records: (3, 400),
        ..Manifest::default()
    };
    let unfinished = Material {
        found: Found::Unfinished(manifest),
        ..material(full())
    };
    let mut torn = material(full());
    torn.problems
        .push("series/a.csv cannot be read: line 2: \"x\" is not a number".to_owned());
    let cases = [
        (material(awkward()), "failed"),
        (material(empty()), "stopped early"),
        (material(silent), "no records of this channel"),
        (unfinished.clone(), "left no summary"),
        (
            unfinished,
            "hil-runtime --set &#39;run.duration=&quot;1 s&quot;&#39;",
        ),
        (torn, "series/a.csv cannot be read"),
    ];
    for (material, expected) in cases {
        let page = html(&material);
        assert_well_formed(&page);
        assert!(page.contains(expected), "{expected}");
        assert!(page.contains("unavailable"), "{expected}");
        let texts = Format::value_variants().iter();
        for format in texts.filter(|one| !matches!(one, Format::Html | Format::Svg)) {
            let text = render(std::slice::from_ref(&material), None, *format, None).unwrap();
            assert!(!text.contains("NaN"), "{format:?}");
        }
    }
}

#[test]
fn a_report_of_any_form_is_known_for_one_that_may_be_replaced() {
    let path = std::env::temp_dir().join(format!("hil-forms-{}", std::process::id()));
    let material = [material(full())];
    let forms = Format::value_variants().iter();
    // Figures are files of their own.
    for format in forms.filter(|one| !matches!(one, Format::Svg | Format::Pdf)) {
        let text = match format {
            Format::Html => html(&material[0]),
            format => render(&material, None, *format, None).unwrap(),
        };
        write::write(&path, text).unwrap();
        write::check(&path, false).unwrap_or_else(|error| panic!("{format:?}: {error}"));
    }
    std::fs::remove_file(path).unwrap();
}

#[test]
fn no_message_is_no_zero_delay() {
    let page = page_of(&[material(empty())], None, 100);
    let all = page.runs[0]
        .sections
        .iter()
        .flat_map(hil_present::Section::metrics);
    let figures: BTreeMap<_, _> = all
        .filter(|(channel, _)| *channel == "arm/command")
        .map(|(_, figure)| (figure.name.clone(), figure.clone()))
        .collect();
    for name in [
        "p50",
        "p99",
        "max",
        "loss_ratio",
        "network_p50",
        "reordered",
    ] {
        let figure = &figures[name];
        assert_eq!(
            (figure.value, figure.text.as_str()),
            (None, "unavailable"),
            "{name}"
        );
        assert!(!figure.method.is_empty(), "{name}");
    }
}

/// As many rows as an hour of a robot at 250 Hz leaves, in 15 columns.
fn long_series(name: &str) -> Series {
    let mut text = "time_s,a,b,c,d,e,f,g,h,i,j,k,l,m,n\n".to_owned();
    for index in 0..66_667_u32 {
        let value = f64::from(index % 977) * 0.001_234_567_891;
        let row = [
            format!("{}", f64::from(index) * 0.015),
            vec![format!("{value}"); 14].join(","),
        ];
        text.push_str(&row.join(","));
        text.push('\n');
    }
    parse(name, &text).unwrap()
}

#[test]
fn a_million_values_make_a_small_page_that_says_it_is_thinned() {
    let mut material = material(full());
    material.series = vec![long_series("robot"), long_series("network-arm-command")];
    let page = html(&material);
    assert!(page.len() < PAGE_BYTES_MAX, "{}", page.len());
    assert!(page.contains("smallest and largest value within"));
    let many = vec![material; 12];
    let page = render(&many, None, Format::Html, None).unwrap();
    assert!(page.contains("12 runs"));
    assert_well_formed(&page);
}

#[test]
fn a_channel_with_a_dot_or_a_hyphen_finds_its_series() {
    for name in ["arm.right/command", "arm-right/command"] {
        let mut material = material(full());
        if let Found::Ended(summary) = &mut material.found {
            let network = summary.network.as_mut().unwrap();
            network.channels[0].channel = name.to_owned();
        }
        assert!(!html(&material).contains("Delay, median"), "in no timeline");
        let text = "time_s,sent_count,lost_count,delay_s_p50,delay_s_max,silence_s_max\n\
                    0,9,1,0.001,0.002,0.01\n1,9,1,0.002,0.003,0.01\n";
        material.series = vec![parse(&network_series_name(name), text).unwrap()];
        assert!(html(&material).contains("Delay, median"), "{name}");
    }
}

#[test]
fn several_runs_get_a_row_each_and_figures_of_their_own() {
    let both = [material(full()), material(empty())];
    let page = page_of(&both, None, 100);
    assert_eq!(page.overview.as_ref().unwrap().rows.len(), 2);
    let text = render(&both, None, Format::Html, None).unwrap();
    assert_well_formed(&text);
    let ids: Vec<&str> = text
        .split(" id=\"")
        .skip(1)
        .filter_map(|rest| rest.split('"').next())
        .collect();
    let mut once = ids.clone();
    once.sort_unstable();
    once.dedup();
    assert_eq!(once.len(), ids.len(), "{ids:?}");
}

#[test]
fn markdown_says_the_name_of_its_only_run_once() {
    let one = material(full());
    let headings = |materials: &[Material]| {
        let text = render(materials, None, Format::Md, None).unwrap();
        let lines = text
            .lines()
            .filter(|line| line.starts_with("# ") || line.starts_with("## "));
        lines.map(str::to_owned).collect::<Vec<_>>()
    };
    assert_eq!(headings(std::slice::from_ref(&one)).len(), 1);
    assert_eq!(headings(&[one, material(full())]).len(), 3);
}

#[test]
fn page_and_markdown_name_the_emulated_links_at_their_head() {
    let mut summary = full();
    summary.run.links = vec![Fact::new("hop", "fixed delay of 5 ms")];
    let one = [material(summary)];
    for (format, words, after) in [
        (Format::Html, "hop: fixed delay of 5 ms", "<section"),
        (Format::Md, "emulated link: hop: fixed delay of 5 ms", "## "),
    ] {
        let page = render(&one, None, format, None)
            .unwrap()
            .replace(JOINT, " ");
        assert!(
            page.find(words).unwrap() < page.find(after).unwrap(),
            "{page}"
        );
    }
}

#[test]
fn the_other_formats_have_the_same_metrics() {
    let one = [material(full())];
    let csv = render(&one, None, Format::Csv, None).unwrap();
    assert!(csv.starts_with("run,channel,figure,value,unit,low,high,method\r\n"));
    assert!(csv.contains("swing-split,arm/command,p99,"), "{csv}");
    let tex = render(&one, None, Format::Tex, None).unwrap();
    assert_eq!(
        tex.matches("\\begin{tabular}").count(),
        tex.matches("\\bottomrule").count()
    );
    assert!(tex.contains("\\toprule"), "{tex}");
    let json: serde_json::Value =
        serde_json::from_str(&render(&one, None, Format::Json, None).unwrap()).unwrap();
    assert_eq!(json["schema_version"], 2);
    let sections = json["runs"][0]["sections"].as_array().unwrap();
    let channels = sections.iter().find(|one| one["id"] == "channels").unwrap();
    assert_eq!(channels["children"][0]["subject"], "arm/command");
    let own = render(
        &one,
        None,
        Format::Html,
        Some(("x.html", "<b>{{ runs[0].name }}</b>")),
    )
    .unwrap();
    assert_eq!(own, "<b>swing-split</b>");
    let error = figure_files(&one, Some("none"), Format::Svg).unwrap_err();
    assert!(
        error.starts_with("no figure \"none\"; figures of this report: "),
        "{error}"
    );
    assert!(error.contains("timeline"), "{error}");
    assert_eq!(
        figure_files(&one, Some("timeline"), Format::Svg)
            .unwrap()
            .len(),
        1
    );
    // Each of the case's series by itself, with the lines that belong together in one panel.
    let mut material = material(full());
    let mut joints = long_series("fig10-joints");
    joints.panel_lines = Some(2);
    material.series = vec![joints];
    let files = figure_files(&[material], Some("fig10-joints"), Format::Svg).unwrap();
    let svg = String::from_utf8(files[0].bytes.clone()).unwrap();
    assert_eq!(svg.matches("class=\"panel\"").count(), 7, "{svg}");
}

/// Ten figures that there are none of, for one reason, around one that there is.
fn for_one_reason() -> RunSummary {
    let mut summary = full();
    let mut given = summary.score[0].clone();
    given.value = None;
    given.interval = None;
    given.method = "no whole motion loop".to_owned();
    let kept = summary.score[0].clone();
    summary.score = (0..10)
        .map(|number| {
            let mut one = given.clone();
            one.name = format!("figure_{number}");
            one.label = format!("motion loops, number {number}");
            one
        })
        .collect();
    summary.score.insert(5, kept);
    summary
}

#[test]
fn a_reason_is_said_once_with_all_that_it_is_for() {
    let summary = for_one_reason();
    let page = html(&material(summary.clone()));
    assert_well_formed(&page);
    // The tile of the first figure says it by itself.
    let reason = "<td class=\"how\">no whole motion loop";
    assert_eq!(page.matches(reason).count(), 1);
    assert!(page.contains("motion loops, number 0, number 1, number 2"));
    assert!(page.contains(&summary.score[5].label));
    let terminal = crate::terminal::render(&summary, 120, Style::Plain);
    assert_eq!(
        terminal.matches("no whole motion loop").count(),
        1,
        "{terminal}"
    );
    assert!(terminal.contains("unavailable, 10: no whole motion loop"));
    let markdown = render(&[material(summary.clone())], None, Format::Md, None).unwrap();
    assert_eq!(markdown.matches("no whole motion loop").count(), 1);
    // Why a loss has no interval is said once.
    let all = render(&[material(full())], None, Format::Csv, None).unwrap();
    let loss = all
        .lines()
        .find(|line| line.contains(",loss_ratio,"))
        .unwrap();
    assert_eq!(loss.matches("independent value").count(), 1, "{loss}");
    // For programs each figure stands by itself.
    let csv = render(&[material(summary)], None, Format::Csv, None).unwrap();
    assert_eq!(csv.matches("no whole motion loop").count(), 10);
}

#[test]
fn long_lists_show_their_beginning_and_how_much_is_folded() {
    let mut summary = full();
    let event = summary.score_events.events[0].clone();
    summary.score_events.events = vec![event; 40];
    summary.warnings = (0..30)
        .map(|number| format!("odd thing {number}"))
        .collect();
    let page = html(&material(summary));
    assert_well_formed(&page);
    assert!(page.contains("34 more incidents and hazards"));
    let warnings = page.split("<h3>Warnings</h3>").nth(1).unwrap();
    let (shown, rest) = warnings.split_once("<details>").unwrap();
    assert!(shown.matches("<li>").count() == 4, "{shown}");
    let folded = rest.split("</details>").next().unwrap();
    assert!(folded.contains("odd thing 29") && folded.contains("more of"));
}

#[test]
fn the_clean_runs_value_stands_below_each_tile() {
    let run = [material(full())];
    let mut summary = full();
    summary.score[0].value = Some(0.001);
    let clean = material(summary);
    let page = render(&run, Some(&clean), Format::Html, None).unwrap();
    assert_well_formed(&page);
    let page = page.replace(JOINT, " ");
    assert!(page.contains("clean run: 0.05730 °"), "{page}");
    assert!(!html(&run[0]).contains("clean run:"));
    let nothing = render(&run, Some(&material(empty())), Format::Html, None).unwrap();
    assert!(nothing.contains("clean run: unavailable"));
}
