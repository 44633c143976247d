//! A figure as PDF: vectors and text, with a font of this host in it.

use std::sync::Arc;

use svg2pdf::usvg::{self, fontdb};
use svg2pdf::{ConversionOptions, PageOptions};

use super::MARK;
use super::svg::for_print;

/// Families that have what our figures say, the first that this host has.
const FAMILIES: [&str; 4] = ["DejaVu Sans", "Liberation Sans", "Noto Sans", "FreeSans"];

/// How figures are read.
///
/// # Errors
/// When this host has no font.
pub(super) fn options() -> Result<usvg::Options<'static>, String> {
    let mut fonts = fontdb::Database::new();
    fonts.load_system_fonts();
    let has = |family: &&&str| {
        let families = [fontdb::Family::Name(family)];
        let query = fontdb::Query {
            families: &families,
            ..fontdb::Query::default()
        };
        fonts.query(&query).is_some()
    };
    let family = FAMILIES.iter().find(has).ok_or_else(|| {
        format!(
            "no font for a PDF on this host, one of {}; apt-get install fonts-dejavu-core",
            FAMILIES.join(", ")
        )
    })?;
    fonts.set_sans_serif_family(*family);
    Ok(usvg::Options {
        font_family: (*family).to_owned(),
        fontdb: Arc::new(fonts),
        ..usvg::Options::default()
    })
}

/// The figure as a page of its size.
///
/// # Errors
/// When it is no SVG.
pub(super) fn of_figure(svg: &str, options: &usvg::Options<'_>) -> Result<Vec<u8>, String> {
    let tree = usvg::Tree::from_str(&for_print(svg), options).map_err(|error| error.to_string())?;
    let pdf = svg2pdf::to_pdf(&tree, ConversionOptions::default(), PageOptions::default());
    let mut pdf = pdf.map_err(|error| error.to_string())?;
    // What follows the end of a PDF is a comment.
    pdf.extend(format!("% {MARK}\n").into_bytes());
    Ok(pdf)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::page::svg::{Anchor, Svg};
    use crate::page::write::{check, write};

    #[test]
    fn a_figure_becomes_a_page_that_may_be_overwritten() {
        let mut svg = Svg::new(200.0, 100.0);
        svg.text("strong", 8.0, 15.0, Anchor::Start, "Delay, µs");
        svg.line("line c1", 0.0, 0.0, 200.0, 100.0);
        let options = match options() {
            Ok(options) => options,
            Err(why) => return assert!(why.starts_with("no font for a PDF on this host"), "{why}"),
        };
        let pdf = of_figure(&svg.finish("t", &[]), &options).unwrap();
        assert!(pdf.starts_with(b"%PDF-1."));
        // With a font in it, so that it looks alike everywhere.
        let has = |bytes: &[u8]| pdf.windows(bytes.len()).any(|part| part == bytes);
        assert!(has(b"/FontFile"));
        let path = std::env::temp_dir().join(format!("hil-figure-{}.pdf", std::process::id()));
        write(&path, &pdf).unwrap();
        check(&path, false).unwrap();
        write(&path, &pdf[..pdf.len() - 1]).unwrap();
        check(&path, false).unwrap_err();
        std::fs::remove_file(path).unwrap();
    }
}
