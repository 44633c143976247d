//! Chaos: short split runs in which processes are killed and paused, the cable is cut, strangers
//! speak and disks fill up, at moments that follow from a seed; and what must hold afterwards
//! whatever happened.
//!
//! [`plan`] draws an episode, [`episode`] runs it, [`act`] does what was drawn, [`forger`] puts
//! datagrams on the cable that no gateway sent, [`verdict`] judges what the run left, and [`table`]
//! counts what was tried.

pub mod act;
pub mod episode;
pub mod forger;
pub mod plan;
pub mod table;
pub mod verdict;
