//! Every seed of the corpus and every regression through its decoder's checks, on the stable
//! toolchain: so neither can rot. Searching for new ones is `tests/fuzz`.
#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "tests")]

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use hil_core::random::RandomStream;
use hil_decoders::{Seed, TARGETS, Target, Verdict};

/// What the corpus may take of the repository.
const CORPUS_BYTES_MAX: usize = 200_000;

/// Inputs made of each seed, and of those that guard a door.
const MUTATION_COUNT: usize = 100;
const DOOR_MUTATION_COUNT: usize = 16_000;

fn below(random: &mut RandomStream, bound: usize) -> usize {
    usize::try_from(random.next_u64() % bound as u64).unwrap()
}

/// Changes, removes, adds or repeats some of the bytes, some of them such as texts turn on.
fn mutate(bytes: &mut Vec<u8>, random: &mut RandomStream) {
    const TELLING: &[u8] = b"\r\n: \tOoHh,/[]@%\x00\x7f\xff\x1b";
    for _ in 0..=below(random, 4) {
        let byte = match below(random, 2) {
            0 => TELLING[below(random, TELLING.len())],
            _ => u8::try_from(below(random, 256)).unwrap(),
        };
        if bytes.is_empty() {
            bytes.push(byte);
        }
        let at = below(random, bytes.len());
        match below(random, 4) {
            0 => bytes[at] = byte,
            1 => drop(bytes.remove(at)),
            2 => bytes.insert(at, byte),
            _ => {
                let end = (at + 1 + below(random, 48)).min(bytes.len());
                let piece = bytes[at..end].to_vec();
                let to = below(random, bytes.len());
                bytes.splice(to..to, piece);
            }
        }
    }
}

/// How many mutations of `seed` mean something.
fn accepted_mutations(target: &Target, seed: &[u8], random: &mut RandomStream) -> usize {
    let count = match target.name {
        "viewer_request" => DOOR_MUTATION_COUNT,
        _ => MUTATION_COUNT,
    };
    let mutated = (0..count).map(|_| {
        let mut bytes = seed.to_vec();
        mutate(&mut bytes, random);
        target.check(&bytes)
    });
    mutated.filter(|one| *one == Verdict::Accepted).count()
}

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
    let mut random = RandomStream::new(1, "mutations of seeds");
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
            let accepted_count = accepted_mutations(target, bytes, &mut random);
            println!(
                "{} {name}: {} bytes; {accepted_count} mutations mean something",
                target.name,
                bytes.len()
            );
            let is_door = ["request-00", "request-01"].contains(&name.as_str());
            assert!(
                !is_door || accepted_count > 1000,
                "{name}: the test would prove nothing"
            );
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
