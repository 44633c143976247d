//! What a bench of cables has beside the product: two programs that know IP and nothing of us, a bare relay
//! between their networks, and what processes cost.

pub mod contestant;
mod processes;
pub mod program;
pub mod relay;
