//! Two hosts with gateways in one process, for the benches of the hop. The gateways are the
//! product's own; here is only what a supervisor would do around them. It measures nothing.
//!
//! - [`network`]: the wire between the hosts; [`hosts`]: their shared memory and their gateways.
//! - [`side`]: one end of a ping-pong, over bare UDP or through gateways.
//! - [`cases`] and [`ends`]: what `gateway_overhead` compares, and with what.
//! - [`turns`]: which case the far thread answers.
//! - [`applications`]: a party per thread, as in a run.
//! - [`stages`]: a hop taken apart in one thread.
//! - [`tap`]: a probe at both ends, while wanted.
//! - [`segments`]: where the time of a hop went.
//! - [`notices`]: what is said before and after.
//! - [`parties`]: processor time and wake-ups of threads; [`verdict`]: aims met and missed.

pub mod applications;
pub mod cases;
pub mod ends;
pub mod hosts;
pub mod network;
pub mod notices;
pub mod parties;
pub mod segments;
pub mod side;
pub mod stages;
pub mod tap;
pub mod turns;
pub mod verdict;
