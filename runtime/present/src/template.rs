//! Data into text by templates (minijinja): HTML, Markdown and `LaTeX`, or a user's own.

use minijinja::{AutoEscape, Environment, ErrorKind, UndefinedBehavior, Value, context};
use serde::Serialize;

use hil_platform::text::visible;

use crate::units::JOINT;
use crate::{Section, joined_labels};

/// Why a template gave no text.
#[derive(Debug, thiserror::Error)]
#[error("template {name}{place}: {text}")]
pub struct TemplateError {
    name: String,
    /// `, line 3`, where it is known.
    place: String,
    text: String,
}

impl TemplateError {
    fn of(name: &str, error: &minijinja::Error) -> Self {
        let detail = error
            .detail()
            .map(|detail| format!(": {detail}"))
            .unwrap_or_default();
        Self {
            name: error.name().unwrap_or(name).to_owned(),
            place: error
                .line()
                .map(|line| format!(", line {line}"))
                .unwrap_or_default(),
            text: format!("{}{detail}", error.kind()),
        }
    }
}

/// What every template may import: each form's macros for sections and their blocks.
const PARTS: [(&str, &str); 3] = [
    ("hil/blocks.html", include_str!("templates/blocks.html")),
    ("hil/blocks.md", include_str!("templates/blocks.md")),
    ("hil/blocks.tex", include_str!("templates/blocks.tex")),
];

/// `data` through the template called `name`, whose ending decides about escaping; `extra` are further
/// names it knows. HTML is escaped wherever a template puts a value that is not marked safe.
///
/// # Errors
/// When the template is at fault, with its line.
pub fn render(
    name: &str,
    text: &str,
    data: &impl Serialize,
    extra: Value,
) -> Result<String, TemplateError> {
    let failed = |error: minijinja::Error| TemplateError::of(name, &error);
    let mut environment = Environment::new();
    environment.set_undefined_behavior(UndefinedBehavior::Strict);
    environment.set_trim_blocks(true);
    environment.set_lstrip_blocks(true);
    let is_html = [".html", ".htm", ".xml", ".svg"].iter().any(|ending| {
        let name = name.trim_end_matches(".j2").trim_end_matches(".jinja");
        name.ends_with(ending)
    });
    environment.set_auto_escape_callback(move |_| {
        if is_html {
            AutoEscape::Html
        } else {
            AutoEscape::None
        }
    });
    // The engine's own escaping also replaces every slash; ours leaves paths readable.
    environment.set_formatter(|out, state, value| {
        let is_text = value.as_str().is_some_and(|_| !value.is_safe());
        if is_text && state.auto_escape() == AutoEscape::Html {
            let text = escaped(&with_joints(value.as_str().unwrap_or_default()));
            return out.write_str(&text).map_err(minijinja::Error::from);
        }
        minijinja::escape_formatter(out, state, value)
    });
    environment.add_filter("md", |text: String| markdown_escaped(&text));
    environment.add_filter("tex", |text: String| tex_escaped(&text));
    environment.add_filter("alike", alike);
    environment.add_filter("xml", |text: String| {
        Value::from_safe_string(escaped(&text))
    });
    for (name, text) in PARTS {
        environment.add_template(name, text).map_err(failed)?;
    }
    environment.add_template(name, text).map_err(failed)?;
    let template = environment.get_template(name).map_err(failed)?;
    let data = Value::from_serialize(data);
    template
        .render(context! { ..extra, ..data })
        .map_err(failed)
}

/// `sections` as GitHub's Markdown below `title`.
///
/// # Errors
/// When a template of this program is at fault.
pub fn markdown(title: &str, sections: &[Section]) -> Result<String, TemplateError> {
    const DOCUMENT: &str = "{% from \"hil/blocks.md\" import section %}\n# {{ title|md }}\n\n\
        {% for s in sections %}\n{{ section(s) }}\n{% endfor %}\n";
    let text = render(
        "document.md",
        DOCUMENT,
        &context! { title, sections },
        context! {},
    )?;
    let mut lines: Vec<&str> = text.lines().map(str::trim_end).collect();
    lines.dedup_by(|one, before| one.is_empty() && before.is_empty());
    Ok(lines.join("\n").replace(JOINT, " "))
}

/// Figures for a table: those that there are none of for one reason make one row, where the first of
/// them stands.
fn alike(figures: Vec<Value>) -> Result<Vec<Value>, minijinja::Error> {
    let mut rows: Vec<(String, Vec<Value>)> = Vec::new();
    for figure in figures {
        let reason = if field(&figure, "value")?.is_none() {
            field(&figure, "method")?.to_string()
        } else {
            String::new()
        };
        let known = rows.iter_mut().find(|(known, _)| *known == reason);
        match known.filter(|_| !reason.is_empty()) {
            Some((_, row)) => row.push(figure),
            None => rows.push((reason, vec![figure])),
        }
    }
    let row = |(_, row): (String, Vec<Value>)| {
        let label = |one: &Value| Ok(field(one, "label")?.to_string());
        let labels = row.iter().map(label);
        let labels = labels.collect::<Result<Vec<String>, minijinja::Error>>()?;
        let labels: Vec<&str> = labels.iter().map(String::as_str).collect();
        let label = joined_labels(&labels);
        Ok(context! { label, ..row[0].clone() })
    };
    rows.into_iter().map(row).collect()
}

/// A field that every figure has; the engine's own look gives an empty text for one that is not there.
fn field(figure: &Value, name: &str) -> Result<Value, minijinja::Error> {
    let found = figure.get_attr(name)?;
    if found.is_undefined() {
        let text = format!("alike: {figure} is no figure, it has no field {name}");
        return Err(minijinja::Error::new(ErrorKind::UndefinedError, text));
    }
    Ok(found)
}

/// Units between which and their number no line of a page may break.
const UNITS: [&str; 28] = [
    "ns", "us", "µs", "ms", "s", "min", "h", "%", "pp", "°", "deg", "deg/s", "°/s", "mm", "m",
    "mm/s", "m/s", "B", "kB", "MB", "GB", "bit/s", "kbit/s", "Mbit/s", "Gbit/s", "Hz", "kHz",
    "MHz",
];

/// With [`JOINT`] between each number and its unit, whoever wrote them.
fn with_joints(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut words = text.split(' ').peekable();
    while let Some(word) = words.next() {
        out.push_str(word);
        if let Some(next) = words.peek() {
            let unit = next.trim_end_matches([',', '.', ';', ':', ')', ']', '?', '!']);
            let is_joined = word.ends_with(|c: char| c.is_ascii_digit()) && UNITS.contains(&unit);
            out.push(if is_joined { JOINT } else { ' ' });
        }
    }
    out
}

/// `text` for XML and HTML, within elements and quoted attributes.
pub fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in visible(text).chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            // XML has no word for these, not even escaped.
            '\u{fffe}' | '\u{ffff}' => out.push('\u{fffd}'),
            _ => out.push(c),
        }
    }
    out
}

/// For a cell of a GitHub table or a line of prose.
fn markdown_escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in visible(text).chars() {
        match c {
            '\\' | '`' | '*' | '_' | '[' | ']' | '|' | '#' | '~' => out.extend(['\\', c]),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '&' => out.push_str("&amp;"),
            '\n' => out.push(' '),
            _ => out.push(c),
        }
    }
    out
}

/// For text in `LaTeX`.
fn tex_escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in visible(text).chars() {
        match c {
            '&' | '%' | '$' | '#' | '_' | '{' | '}' => out.extend(['\\', c]),
            '\\' => out.push_str(r"\textbackslash{}"),
            '~' => out.push_str(r"\textasciitilde{}"),
            '^' => out.push_str(r"\textasciicircum{}"),
            '<' => out.push_str(r"\textless{}"),
            '>' => out.push_str(r"\textgreater{}"),
            'µ' => out.push_str(r"\textmu{}"),
            '‰' => out.push_str(r"\textperthousand{}"),
            '→' => out.push_str(r"$\rightarrow$"),
            '≤' => out.push_str(r"$\le$"),
            '±' => out.push_str(r"$\pm$"),
            '−' => out.push_str("$-$"),
            '–' => out.push_str("--"),
            '\n' => out.push(' '),
            _ => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn on_a_page_a_number_and_its_unit_stay_together() {
        let text = "up to 3.88 % lost (every 4.00 ms), 60.0 s in 5 messages";
        let page = render("page.html", "{{ text }}", &context! { text }, context! {}).unwrap();
        let expected = "up to 3.88\u{a0}% lost (every 4.00\u{a0}ms), 60.0\u{a0}s in 5 messages";
        assert_eq!(page, expected);
        let plain = render("page.txt", "{{ text }}", &context! { text }, context! {}).unwrap();
        assert_eq!(plain, text);
    }

    #[test]
    fn each_language_keeps_a_text_a_text() {
        assert_eq!(markdown_escaped("a|b_<c>\n"), "a\\|b\\_&lt;c&gt; ");
        assert_eq!(markdown_escaped("\u{1b}]0;x\u{7}"), "\\\\x1b\\]0;x\\\\x07");
        assert_eq!(escaped("\u{9b}2J\u{202e}<b>"), "\\x9b2J\\u{202e}&lt;b&gt;");
        assert_eq!(tex_escaped("\u{1b}"), r"\textbackslash{}x1b");
        assert_eq!(tex_escaped("5 % of a_b\\"), r"5 \% of a\_b\textbackslash{}");
    }

    #[test]
    fn a_faulty_template_is_named_with_its_line() {
        let page = context! { title => "0 runs" };
        let error = render("mine.txt", "a\n{{ title }\n", &page, context! {})
            .unwrap_err()
            .to_string();
        assert!(error.starts_with("template mine.txt, line 2: "), "{error}");
        let error = render("mine.txt", "{{ titel }}", &page, context! {})
            .unwrap_err()
            .to_string();
        assert!(error.contains("undefined"), "{error}");
        assert_eq!(
            render("mine.txt", "{{ title }}", &page, context! {}).unwrap(),
            "0 runs"
        );
    }

    #[test]
    fn what_is_no_figure_is_an_error_and_not_an_empty_row() {
        let page = context! { title => "0 runs" };
        let used = |figures: &str| {
            let text = format!("\n{{{{ [{figures}]|alike|length }}}}");
            render("mine.txt", &text, &page, context! {})
        };
        assert_eq!(
            used("{'label': 'a', 'value': 1, 'method': ''}").unwrap(),
            "\n1"
        );
        for (figures, missing) in [
            ("{'name': 'a', 'value': 1, 'method': ''}", "label"),
            ("{'label': 'a', 'method': ''}", "value"),
            ("{'label': 'a', 'value': none}", "method"),
            ("'a'", "value"),
        ] {
            let error = used(figures).unwrap_err().to_string();
            assert!(error.starts_with("template mine.txt, line 2: "), "{error}");
            assert!(error.contains(&format!("no field {missing}")), "{error}");
        }
    }
}
