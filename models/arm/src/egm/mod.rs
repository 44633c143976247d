//! Externally guided motion (EGM): the interface by which an outside computer drives an ABB robot's
//! joints in its 4 ms cycle, and a simulated controller that speaks it. It opens no socket: see
//! the adapters in `hil_runtime`.
//!
//! 1. [`messages`]: what crosses shared memory and our own gateways.
//! 2. [`parameters`]: every setting of the controller, and presets of them.
//! 3. [`controller`]: one arm's motion task as a state machine that is told the time.
//! 4. [`wire`]: the maker's datagrams, encoded and decoded; of use by itself.
//! 5. [`adapter`]: between those datagrams and our messages, as robot or as sensor.
//!
//! A client one millisecond away drives one arm for three seconds, then falls silent, all in
//! virtual time:
//!
//! ```
//! use hil_arm::egm::controller::Controller;
//! use hil_arm::egm::messages::{EgmCommand, EgmEvent, EgmEventKind, Side};
//! use hil_arm::egm::parameters::{EgmParameters, StartMode};
//! use hil_core::time::Instant;
//! use hil_arm::yumi::arm::RIGHT_START_RAD;
//!
//! let parameters = EgmParameters { start: Some(StartMode::PowerOn), ..Default::default() };
//! let settings = parameters.settings()?;
//! let mut controller = Controller::new(Side::Right, settings, RIGHT_START_RAD);
//! let mut command: EgmCommand = bytemuck::Zeroable::zeroed();
//! command.position_rad = RIGHT_START_RAD;
//! command.position_rad[0] += 0.1;
//! let mut events: Vec<EgmEvent> = Vec::new();
//! for cycle in 0..1250 {
//!     let at = Instant::from_ns(cycle * 4_000_000);
//!     controller.cycle(at, &mut |event| events.push(event));
//!     if cycle < 750 {
//!         let arrival = Instant::from_ns(at.as_ns() + 1_000_000);
//!         let is_usable = controller.receive(arrival, &command).is_ok();
//!         assert!(is_usable);
//!     }
//! }
//! assert!((controller.measured_rad()[0] - command.position_rad[0]).abs() < 1e-6);
//! let end = events.iter().find(|event| event.kind == EgmEventKind::Ended as u32);
//! let line = end.map(EgmEvent::describe);
//! assert_eq!(
//!     line.as_deref(),
//!     Some("right arm: EGM session 1 ended: no message for 1.003 s (CommTimeout = 1 s)")
//! );
//! # Ok::<(), hil_core::case_study::ParameterError>(())
//! ```
//!
//! Source of the behaviour: ABB, "Externally Guided Motion" (`RobotWare` 7, revision K); where it
//! is silent, the item says what was assumed.

pub mod adapter;
pub mod controller;
pub mod messages;
pub mod parameters;
pub mod wire;
