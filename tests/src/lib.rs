//! Shared by the tests that cross crate and process borders: two hosts on one machine, the built
//! binary, children that do not outlive their test, folders that clean up after themselves. It
//! holds no test of the product.

pub mod account;
pub mod arms;
pub mod attacker;
pub mod binary;
pub mod browser;
pub mod chaos;
pub mod child;
pub mod knocker;
pub mod lab;
pub mod latency;
pub mod live_server;
pub mod machine_lock;
pub mod mcap_file;
pub mod ports;
pub mod run_folder;
pub mod shown;
pub mod shuttle;
pub mod soak;
pub mod source_tree;
pub mod split;
pub mod trial;
pub mod turns;
pub mod worker;
