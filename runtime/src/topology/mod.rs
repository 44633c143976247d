//! The topology file: hosts, processes, channels and links in TOML.

mod model;

pub use model::{
    Case, Channel, ChannelPorts, Crossing, Direction, Emulation, Execution, Gateway, Hop, Host,
    Impairment, Link, MessageLayout, OnExit, Process, Program, Run, Scheduling, Timestamps,
    Topology, Via, Wait,
};
