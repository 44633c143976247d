//! A small writer of SVG: it puts shapes and escaped text into a picture and knows no figure. Colours
//! and widths are classes of one style sheet, so that a page can turn dark and a file stands alone.

use core::fmt::Write;

use hil_present::template::escaped;

/// The style sheet of figures, for the page and for files of their own.
pub(super) const STYLE: &str = include_str!("templates/figure.css");

/// Lines that can be told apart by colour alone, also by the colour-blind (Okabe and Ito, 2008).
/// Dashes tell further ones apart.
pub(super) const COLOUR_COUNT: usize = 7;

/// Attributes of an element with their values escaped.
fn attribute_list<'a>(attributes: impl Iterator<Item = (&'a str, &'a str)>) -> String {
    let attributes = attributes.map(|(name, value)| format!(" {name}=\"{}\"", escaped(value)));
    attributes.collect()
}

/// A coordinate: a tenth of a pixel is enough.
pub(super) fn px(value: f64) -> String {
    let text = format!("{value:.1}");
    match text.strip_suffix(".0") {
        Some("-0") => "0".to_owned(),
        Some(whole) => whole.to_owned(),
        None => text,
    }
}

/// The classes of the line with this number.
pub(super) fn line_class(index: usize) -> String {
    let round = (index / COLOUR_COUNT).min(3);
    format!("line c{} d{round}", index % COLOUR_COUNT)
}

/// A picture under way.
#[derive(Debug)]
pub(super) struct Svg {
    width: f64,
    height: f64,
    body: String,
}

/// Where a text is anchored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Anchor {
    Start,
    Middle,
    End,
}

impl Svg {
    pub(super) const fn new(width: f64, height: f64) -> Self {
        Self {
            width,
            height,
            body: String::new(),
        }
    }

    fn put(&mut self, args: core::fmt::Arguments<'_>) {
        // Writing to a string cannot fail.
        let _infallible = self.body.write_fmt(args);
        self.body.push('\n');
    }

    pub(super) fn line(&mut self, class: &str, x1: f64, y1: f64, x2: f64, y2: f64) {
        let [x1, y1, x2, y2] = [x1, y1, x2, y2].map(px);
        self.put(format_args!(
            r#"<line class="{class}" x1="{x1}" y1="{y1}" x2="{x2}" y2="{y2}"/>"#
        ));
    }

    /// A rectangle with what a pointer that rests on it is told.
    pub(super) fn rect(
        &mut self,
        class: &str,
        x: f64,
        y: f64,
        width: f64,
        height: f64,
        title: &str,
    ) {
        let [x, y, width, height] = [x, y, width.max(0.0), height.max(0.0)].map(px);
        let title = if title.is_empty() {
            String::new()
        } else {
            format!("<title>{}</title>", escaped(title))
        };
        self.put(format_args!(
            r#"<rect class="{class}" x="{x}" y="{y}" width="{width}" height="{height}">{title}</rect>"#
        ));
    }

    /// A path whose `d` the caller made of numbers.
    pub(super) fn path(&mut self, class: &str, d: &str) {
        if !d.is_empty() {
            self.put(format_args!(r#"<path class="{class}" d="{d}"/>"#));
        }
    }

    pub(super) fn text(&mut self, class: &str, x: f64, y: f64, anchor: Anchor, text: &str) {
        let anchor = match anchor {
            Anchor::Start => "start",
            Anchor::Middle => "middle",
            Anchor::End => "end",
        };
        let ([x, y], text) = ([x, y].map(px), escaped(text));
        self.put(format_args!(
            r#"<text class="{class}" x="{x}" y="{y}" text-anchor="{anchor}">{text}</text>"#
        ));
    }

    /// Begins a group; `attributes` are pairs whose values get escaped.
    pub(super) fn open(&mut self, attributes: &[(&str, &str)]) {
        let list = attribute_list(attributes.iter().copied());
        self.put(format_args!("<g{list}>"));
    }

    pub(super) fn close(&mut self) {
        self.put(format_args!("</g>"));
    }

    /// Nothing outside this rectangle is seen of groups that name it.
    pub(super) fn clip(&mut self, id: &str, x: f64, y: f64, width: f64, height: f64) {
        let [x, y, width, height] = [x, y, width, height].map(px);
        let id = escaped(id);
        self.put(format_args!(
            r#"<clipPath id="{id}"><rect x="{x}" y="{y}" width="{width}" height="{height}"/></clipPath>"#
        ));
    }

    /// The picture; `attributes` go to its outermost element, `title` is what a reader without eyes
    /// is told.
    pub(super) fn finish(self, title: &str, attributes: &[(&str, String)]) -> String {
        let attributes = attributes.iter();
        let list = attribute_list(attributes.map(|(name, value)| (*name, value.as_str())));
        let ([width, height], title) = ([self.width, self.height].map(px), escaped(title));
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" class=\"figure\" role=\"img\" viewBox=\"0 0 {width} \
             {height}\"{list}>\n<title>{title}</title>\n{}</svg>\n",
            self.body
        )
    }
}

/// `svg` as a file of its own: with its style, on white paper.
pub(super) fn standalone(svg: &str) -> String {
    let style = format!("<style>{STYLE}\nsvg.figure {{ background: var(--paper); }}</style>");
    match svg.split_once('\n') {
        Some((head, rest)) => {
            format!("<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n{head}\n{style}\n{rest}")
        }
        None => svg.to_owned(),
    }
}

/// `svg` for renderers without variables and media queries in style sheets: with the colours for print.
pub(super) fn for_print(svg: &str) -> String {
    let (plain, rules) = STYLE
        .split_once("svg.figure {")
        .expect("the sheet has variables, then rules");
    let print = plain
        .split_once("@media print")
        .expect("the sheet has colours for print")
        .1;
    let mut rules = format!("svg.figure {{{rules}");
    for declaration in print.split([';', '{', '}']) {
        if let Some((name, value)) = declaration.split_once(':') {
            rules = rules.replace(&format!("var({})", name.trim()), value.trim());
        }
    }
    match svg.split_once('\n') {
        Some((head, rest)) => format!("{head}\n<style>{rules}</style>\n{rest}"),
        None => svg.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whatever_a_text_holds_stays_text() {
        assert_eq!(
            escaped("<b a='1'>\"&\u{0}\u{1b}µ"),
            "&lt;b a=&#39;1&#39;&gt;&quot;&amp;\\x00\\x1bµ"
        );
        let mut svg = Svg::new(10.0, 20.0);
        svg.text("x", 1.0, 2.04, Anchor::Middle, "</text><script>");
        svg.rect("x", 0.0, 0.0, -1.0, 2.0, "a<b");
        let text = svg.finish("<t>", &[("data-x", "\"y".to_owned())]);
        assert!(text.contains("&lt;/text&gt;&lt;script&gt;"), "{text}");
        assert!(text.contains("data-x=\"&quot;y\""), "{text}");
        assert!(text.contains("width=\"0\""), "{text}");
        assert!(!text.contains("<script"), "{text}");
    }

    #[test]
    fn coordinates_are_short() {
        assert_eq!([0.0, -0.01, 1.25, 3.0].map(px), ["0", "0", "1.2", "3"]);
    }

    #[test]
    fn print_has_colours_and_no_variables() {
        let text = for_print(&Svg::new(1.0, 1.0).finish("t", &[]));
        assert!(
            !text.contains("var(") && !text.contains("@media") && !text.contains("--"),
            "{text}"
        );
        assert!(
            text.contains("svg.figure text { fill: #000000; }"),
            "{text}"
        );
    }

    #[test]
    fn a_file_of_its_own_has_its_style() {
        let text = standalone(&Svg::new(1.0, 1.0).finish("t", &[]));
        assert!(text.starts_with("<?xml"), "{text}");
        assert!(
            text.contains("<style>") && text.ends_with("</svg>\n"),
            "{text}"
        );
    }
}
