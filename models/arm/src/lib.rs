//! The dual-arm robot of the seed paper: [`yumi`], its kinematics and inverse kinematics, and [`egm`],
//! the maker's guided-motion interface with a simulated controller of it.
#![forbid(unsafe_code)]

pub mod egm;
pub mod yumi;
