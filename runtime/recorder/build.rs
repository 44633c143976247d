//! Makes one HTML page of the files of the folder `page`: style and scripts go into it, so that a
//! browser asks once and has all of it or nothing. The modules become one script, so no two of them
//! declare the same name. What it writes: `page.html`, and the digests by which the page's policy
//! knows its own style and script.

use std::path::PathBuf;
use std::{env, fs, io};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use sha2::{Digest, Sha256};

const STYLE_LINK: &str = "<link rel=\"stylesheet\" href=\"page.css\">\n";
const SCRIPT_LINK: &str = "<script type=\"module\" src=\"main.js\"></script>\n";
/// Uses what the other modules declare when it is run.
const LAST_MODULE: &str = "main.js";

fn main() -> io::Result<()> {
    println!("cargo:rerun-if-changed=page");
    println!("cargo:rerun-if-changed=build.rs");
    let variable = |name: &str| env::var_os(name).map(PathBuf::from).unwrap_or_default();
    let folder = variable("CARGO_MANIFEST_DIR").join("page");
    let entries = fs::read_dir(&folder)?.map(|entry| Ok(entry?.path()));
    let mut modules: Vec<PathBuf> = entries.collect::<io::Result<_>>()?;
    modules.retain(|path| path.extension().is_some_and(|extension| extension == "js"));
    modules.sort_by_key(|path| (path.ends_with(LAST_MODULE), path.clone()));
    let mut script = "\n".to_owned();
    for path in modules {
        for line in fs::read_to_string(path)?.lines() {
            // All names are there already, and a bare list of them declares nothing.
            if !line.starts_with("import ") && !line.starts_with("export {") {
                script.push_str(line.strip_prefix("export ").unwrap_or(line));
                script.push('\n');
            }
        }
    }
    let style = format!("\n{}", fs::read_to_string(folder.join("page.css"))?);
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
    let fault = |words: String| Err(io::Error::new(io::ErrorKind::InvalidData, words));
    if page.matches(link).count() != 1 {
        return fault(format!("index.html: not once: {link}"));
    }
    if by.matches("</").count() != 1 {
        return fault(format!("{link} has a closing tag in it"));
    }
    Ok(page.replacen(link, by, 1))
}
