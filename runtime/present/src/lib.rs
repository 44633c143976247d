//! What a report is made of, and how each form shows it. A builder makes [`Section`]s of typed blocks; an
//! emitter turns them into text for one form and knows no run: [`terminal`] for a terminal, [`template`] for
//! HTML, Markdown, LaTeX and a user's own templates, [`csv`] for every metric as a row. Sections serialise, which
//! makes JSON of them.

mod alike;
pub mod csv;
mod model;
pub mod template;
pub mod terminal;
pub mod units;

pub use alike::joined_labels;
pub use model::{
    Bar, Block, Cell, Column, Drawing, Event, EventList, Field, Metric, Row, Section, Strip,
    Strips, Table, Tone, UNAVAILABLE,
};
