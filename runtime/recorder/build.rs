//! Makes the files of the folder `page` part of the program, whichever there are.

use std::env;
use std::fmt::Write as _;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// Files of a page; anything else in the folder is not for browsers.
const EXTENSIONS: [&str; 8] = ["css", "html", "js", "json", "mjs", "png", "svg", "woff2"];

fn main() -> io::Result<()> {
    println!("cargo:rerun-if-changed=page");
    println!("cargo:rerun-if-changed=build.rs");
    let variable = |name: &str| env::var_os(name).map(PathBuf::from).unwrap_or_default();
    let folder = variable("CARGO_MANIFEST_DIR").join("page");
    let mut files = Vec::new();
    if folder.is_dir() {
        list(&folder, &folder, &mut files)?;
    }
    files.sort();
    let mut table = String::from("pub(crate) static PAGE_FILES: &[(&str, &[u8])] = &[\n");
    for (name, path) in files {
        let path = path.to_string_lossy().into_owned();
        let _infallible = writeln!(table, "    ({name:?}, include_bytes!({path:?})),");
    }
    table.push_str("];\n");
    fs::write(variable("OUT_DIR").join("page_files.rs"), table)
}

fn list(root: &Path, folder: &Path, files: &mut Vec<(String, PathBuf)>) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        let name = path
            .file_name()
            .map(|name| name.to_string_lossy().into_owned());
        let name = name.unwrap_or_default();
        if name.starts_with('.') || name == "test" || name == "tests" || name == "node_modules" {
            continue;
        }
        if path.is_dir() {
            list(root, &path, files)?;
            continue;
        }
        let extension = path.extension().and_then(|extension| extension.to_str());
        if extension.is_some_and(|extension| EXTENSIONS.contains(&extension)) {
            let below = path.strip_prefix(root).unwrap_or(&path);
            files.push((below.to_string_lossy().into_owned(), path.clone()));
        }
    }
    Ok(())
}
