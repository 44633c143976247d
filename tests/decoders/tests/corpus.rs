//! Every seed of the corpus and every regression through its decoder's checks, on the stable
//! toolchain: so neither can rot. Searching for new ones is `tests/fuzz`.
#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "tests")]

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use hil_decoders::{Seed, TARGETS, Verdict};

/// What the corpus may take of the repository.
const CORPUS_BYTES_MAX: usize = 200_000;

/// The files of a folder by name; none when there is no such folder.
fn files(folder: &Path) -> Vec<Seed> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let mut files: Vec<Seed> = entries
        .map(|entry| {
            let name = entry.file_name().to_string_lossy().into_owned();
            (name, fs::read(entry.path()).unwrap())
        })
        .collect();
    files.sort();
    files
}

/// One test, so that nothing else allocates while memory is counted.
#[test]
fn every_decoder_keeps_its_promises_for_the_corpus_and_all_regressions() {
    let mut total_bytes = 0;
    for target in TARGETS {
        let (seeds, regressions) = (
            files(&target.corpus_folder()),
            files(&target.regressions_folder()),
        );
        let mut made = target.seeds();
        made.sort();
        assert!(
            seeds == made,
            "the corpus of {} is not what its generator makes; a format has changed: cargo run \
             --package hil-decoders --bin make_corpus",
            target.name
        );
        let mut verdicts = BTreeSet::new();
        for (name, bytes) in seeds.iter().chain(&regressions) {
            println!("{} {name}: {} bytes", target.name, bytes.len());
            verdicts.insert(target.check(bytes));
            total_bytes += bytes.len();
            // What a search tries first.
            target.check(&bytes[..bytes.len() / 2]);
            let mut flipped = bytes.clone();
            if let Some(byte) = flipped.last_mut() {
                *byte ^= 0x55;
            }
            target.check(&flipped);
        }
        assert!(
            verdicts.contains(&Verdict::Accepted),
            "no seed of {} means anything: a search would stop at its first check",
            target.name
        );
        target.check(&[]);
    }
    assert!(
        total_bytes <= CORPUS_BYTES_MAX,
        "{total_bytes} bytes of seeds, at most {CORPUS_BYTES_MAX}"
    );
    println!("{} decoders, {total_bytes} bytes of seeds", TARGETS.len());
}

#[test]
fn the_folders_are_those_of_decoders_that_there_are() {
    let package = Path::new(env!("CARGO_MANIFEST_DIR"));
    let known: BTreeSet<&str> = TARGETS.iter().map(|target| target.name).collect();
    assert_eq!(known.len(), TARGETS.len(), "two targets of one name");
    for folder in ["corpus", "regressions"] {
        for entry in fs::read_dir(package.join(folder)).into_iter().flatten() {
            let name = entry.unwrap().file_name().to_string_lossy().into_owned();
            assert!(
                known.contains(name.as_str()),
                "{folder}/{name} is of no decoder"
            );
        }
    }
    let manifest = fs::read_to_string(package.join("../fuzz/Cargo.toml")).unwrap();
    let lines = manifest
        .lines()
        .filter_map(|line| line.strip_prefix("name = \""));
    let targets: BTreeSet<&str> = lines
        .map(|line| line.trim_end_matches('"'))
        .skip(1)
        .collect();
    assert_eq!(targets, known, "tests/fuzz has other targets");
}
