//! The case studies a binary ships, as far as a topology file can name them. It builds no role
//! and runs nothing: that is the caller's registry.

use std::collections::BTreeMap;

use hil_core::case_study::{CaseStudy, ChannelSpec, ParameterError};
use hil_core::options::Options;

/// The case studies that `[case] name` may say.
#[derive(Debug, Clone, Default)]
pub struct KnownCases {
    cases: BTreeMap<&'static str, KnownCase>,
}

/// One case study: its roles, its channels, and how its parameters are checked.
#[derive(Debug, Clone, Copy)]
pub struct KnownCase {
    /// What `[case] name` says.
    pub name: &'static str,
    /// Its roles.
    pub roles: &'static [&'static str],
    /// Its channels, in port order.
    pub channels: &'static [ChannelSpec],
    /// Whether a role may be started anew in the midst of a run with these, checked, parameters.
    pub may_restart: fn(&toml::Table, &str) -> bool,
    /// Has `[case.parameters]` read, checks them with a seed and gives them back with every default filled in.
    pub check_parameters: ParameterCheck,
}

/// See [`KnownCase::check_parameters`].
pub type ParameterCheck =
    fn(ReadParameters<'_>, u64) -> Result<Option<toml::Table>, ParameterError>;

/// Reads the parameters of the file; false, and the faults are noted, when they cannot be used.
pub type ReadParameters<'r> = &'r mut dyn FnMut(&mut dyn Options) -> bool;

impl KnownCases {
    /// No case at all: topologies of the user's own programs only.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds the case study `C`; a case added twice is there once.
    #[must_use]
    pub fn with<C: CaseStudy>(self) -> Self {
        self.with_case(KnownCase::of::<C>())
    }

    /// Adds a case described by hand.
    #[must_use]
    pub fn with_case(mut self, case: KnownCase) -> Self {
        self.cases.insert(case.name, case);
        self
    }

    /// The case called `name`.
    pub fn get(&self, name: &str) -> Option<&KnownCase> {
        self.cases.get(name)
    }

    /// All names, sorted.
    pub fn names(&self) -> impl Iterator<Item = &'static str> {
        self.cases.keys().copied()
    }
}

impl KnownCase {
    /// What a topology needs to know about `C`.
    pub fn of<C: CaseStudy>() -> Self {
        Self {
            name: C::NAME,
            roles: C::ROLES,
            channels: C::CHANNELS,
            may_restart: may_restart::<C>,
            check_parameters: check_parameters::<C>,
        }
    }
}

fn may_restart<C: CaseStudy>(checked: &toml::Table, role: &str) -> bool {
    let parameters = checked.clone().try_into::<C::Parameters>();
    parameters.is_ok_and(|parameters| C::may_restart(&parameters, role))
}

fn check_parameters<C: CaseStudy>(
    read: ReadParameters<'_>,
    seed: u64,
) -> Result<Option<toml::Table>, ParameterError> {
    check_parameters_with::<C>(read, seed, &mut |_| Ok(()))
}

/// The [`ParameterCheck`] of `C` with a step between reading and checking the parameters, for a
/// case whose parameters name files that someone must open for it. What was read is given back with every
/// default filled in; nothing where it could not be read.
///
/// # Errors
/// What `prepare` says, else what the case says.
pub fn check_parameters_with<C: CaseStudy>(
    read: ReadParameters<'_>,
    seed: u64,
    prepare: &mut dyn FnMut(&mut C::Parameters) -> Result<(), ParameterError>,
) -> Result<Option<toml::Table>, ParameterError> {
    let mut parameters = C::Parameters::default();
    if !read(&mut parameters) {
        return Ok(None);
    }
    let complete = toml::Table::try_from(&parameters)
        .map_err(|error| ParameterError::new("", format!("cannot be written as TOML: {error}")))?;
    prepare(&mut parameters)?;
    C::new(parameters, seed)?;
    Ok(Some(complete))
}
