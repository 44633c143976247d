//! The processes a run is made of: components and gateways, and how they talk with the
//! supervisor that started them.

pub(crate) mod component;
pub(crate) mod direction;
pub(crate) mod egress;
pub(crate) mod gateway;
pub(crate) mod ingress;
pub mod launch;
pub mod pipe;
pub(crate) mod recording;
pub(crate) mod usage;
