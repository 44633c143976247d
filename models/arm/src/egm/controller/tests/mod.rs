//! Tests of [`super`]: what the maker documents and what was measured elsewhere, each as a claim.

mod following;
mod outages;
mod queueing;
mod rig;
mod robustness;
mod sessions;
mod words;
