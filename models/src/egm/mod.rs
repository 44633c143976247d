//! Externally guided motion (EGM): the interface by which an outside computer drives an ABB robot's
//! joints in its 4 ms cycle, and a simulated controller that speaks it. It opens no socket: see
//! the faces in `hil_runtime`.
//!
//! 1. [`messages`]: what crosses shared memory and our own gateways.
//! 2. [`parameters`]: every setting of the controller, and presets of them.
//! 3. [`controller`]: one arm's motion task as a state machine that is told the time.
//! 4. [`wire`]: the maker's datagrams, encoded and decoded; of use by itself.
//! 5. [`face`]: between those datagrams and our messages, as robot or as sensor.
//!
//! Source of the behaviour: ABB, "Externally Guided Motion" (`RobotWare` 7, revision K); where it
//! is silent, the item says what was assumed.

pub mod controller;
pub mod face;
pub mod messages;
pub mod parameters;
pub mod wire;
