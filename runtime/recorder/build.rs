//! Makes one HTML page of the files of the folder `page`: style and scripts go into it, so that a
//! browser asks once and has all of it or nothing, and a file that is added is part of it by being
//! imported. What it writes: `page.html`, and the digests by which the page's policy knows its own
//! style and script.

use std::env;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use sha2::{Digest, Sha256};

const STYLE_LINK: &str = "<link rel=\"stylesheet\" href=\"page.css\">\n";
const SCRIPT_LINK: &str = "<script type=\"module\" src=\"main.js\"></script>\n";
const FIRST_MODULE: &str = "main.js";

fn main() -> io::Result<()> {
    println!("cargo:rerun-if-changed=page");
    println!("cargo:rerun-if-changed=build.rs");
    let variable = |name: &str| env::var_os(name).map(PathBuf::from).unwrap_or_default();
    let folder = variable("CARGO_MANIFEST_DIR").join("page");
    let mut bundle = Bundle {
        folder: &folder,
        open: Vec::new(),
        done: Vec::new(),
        script: String::new(),
    };
    bundle.add(FIRST_MODULE)?;
    let style = format!("\n{}", fs::read_to_string(folder.join("page.css"))?);
    let script = format!("\n{}", bundle.script);
    let page = fs::read_to_string(folder.join("index.html"))?;
    let page = replaced(&page, STYLE_LINK, &format!("<style>{style}</style>\n"))?;
    let script_tag = format!("<script type=\"module\">{script}</script>\n");
    let page = replaced(&page, SCRIPT_LINK, &script_tag)?;
    let output = variable("OUT_DIR");
    fs::write(output.join("page.html"), page)?;
    for (name, text) in [("style", style), ("script", script)] {
        let digest = STANDARD.encode(Sha256::digest(text.as_bytes()));
        fs::write(output.join(format!("{name}.digest")), digest)?;
    }
    Ok(())
}

fn replaced(page: &str, link: &str, by: &str) -> io::Result<String> {
    if page.matches(link).count() != 1 {
        return Err(fault(format!("index.html: not once: {link}")));
    }
    if by.matches("</").count() != 1 {
        return Err(fault(format!("{link} has a closing tag in it")));
    }
    Ok(page.replacen(link, by, 1))
}

fn fault(words: String) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, words)
}

/// Modules one after the other, each after those it imports, each a function that gives what the
/// module exports: names of one do not meet names of another.
struct Bundle<'a> {
    folder: &'a Path,
    /// Modules that are waiting for what they import.
    open: Vec<String>,
    done: Vec<String>,
    script: String,
}

impl Bundle<'_> {
    fn add(&mut self, name: &str) -> io::Result<()> {
        if self.done.iter().any(|one| one == name) {
            return Ok(());
        }
        if self.open.iter().any(|one| one == name) {
            return Err(fault(format!("{name} imports itself: {:?}", self.open)));
        }
        self.open.push(name.to_owned());
        let text = fs::read_to_string(self.folder.join(name))?;
        let (mut body, mut exports) = (String::new(), Vec::new());
        for line in text.lines() {
            let line = if line.starts_with("import ") {
                &self.import(name, line)?
            } else if let Some(exported) = line.strip_prefix("export ") {
                exports.push(exported_name(name, exported)?);
                // A bare list of names declares nothing.
                if exported.starts_with('{') {
                    ""
                } else {
                    exported
                }
            } else {
                line
            };
            body.push_str(line);
            body.push('\n');
        }
        self.script.push_str("const ");
        self.script.push_str(&variable(name));
        self.script.push_str(" = (() => {\n");
        self.script.push_str(&body);
        self.script.push_str("return { ");
        self.script.push_str(&exports.join(", "));
        self.script.push_str(" };\n})();\n");
        self.open.pop();
        self.done.push(name.to_owned());
        Ok(())
    }

    /// `import { A, B } from "./x.js";` as names taken from what the function of `x.js` gave.
    fn import(&mut self, name: &str, line: &str) -> io::Result<String> {
        let parts = line
            .strip_prefix("import ")
            .and_then(|rest| rest.strip_suffix("\";"))
            .and_then(|rest| rest.split_once(" from \"./"));
        let Some((names, from)) = parts.filter(|(names, _)| is_list(names)) else {
            let wanted = "import { A, B } from \"./x.js\";";
            return Err(fault(format!("{name}: not of the form {wanted}: {line}")));
        };
        self.add(from)?;
        Ok(format!("const {names} = {};", variable(from)))
    }
}

fn is_list(names: &str) -> bool {
    names.starts_with("{ ") && names.ends_with(" }") && !names.contains(" as ")
}

fn variable(module: &str) -> String {
    format!("module_{}", module.trim_end_matches(".js"))
}

/// The name or names that a declaration behind `export ` gives.
fn exported_name(module: &str, declaration: &str) -> io::Result<String> {
    let list = declaration.trim_end_matches(';');
    if is_list(list) {
        return Ok(list[2..list.len() - 2].to_owned());
    }
    let mut words = declaration.split(|c: char| !c.is_alphanumeric() && c != '_');
    match (words.next(), words.next()) {
        (Some("class" | "const" | "function"), Some(name)) if !name.is_empty() => {
            Ok(name.to_owned())
        }
        _ => Err(fault(format!(
            "{module}: not understood: export {declaration}"
        ))),
    }
}
