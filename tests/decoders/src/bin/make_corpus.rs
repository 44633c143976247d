//! Writes the corpus of every decoder anew, from the product's own encoders. Run it when a format
//! has changed; `tests/corpus.rs` says when that is due.
//!
//! ```text
//! cargo run --package hil-decoders --bin make_corpus
//! ```

use std::{fs, io};

use hil_decoders::TARGETS;

fn main() -> io::Result<()> {
    for target in TARGETS {
        let folder = target.corpus_folder();
        if folder.exists() {
            fs::remove_dir_all(&folder)?;
        }
        fs::create_dir_all(&folder)?;
        for (name, bytes) in target.seeds() {
            fs::write(folder.join(name), bytes)?;
        }
    }
    Ok(())
}
