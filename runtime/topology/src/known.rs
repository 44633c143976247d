//! The case studies a binary ships, as far as a topology file can name them. It builds no role
//! and runs nothing: that is the caller's registry.

use std::collections::BTreeMap;

use hil_core::case_study::{CaseStudy, ChannelSpec, ParameterError};
use serde::Deserialize;

use super::parameter_reader::{ReadError, read};

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
    /// Checks `[case.parameters]` with a seed and gives them back with every default filled in.
    pub check_parameters: ParameterCheck,
}

/// See [`KnownCase::check_parameters`].
pub type ParameterCheck = fn(&toml::Table, u64) -> Result<toml::Table, Vec<ParameterFault>>;

/// What is wrong with one parameter.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ParameterFault {
    /// Path below `[case.parameters]`; empty for the table as a whole.
    pub key: Vec<String>,
    /// What is wrong, lower-case, without full stop.
    pub message: String,
    /// True when the case has no parameter of that name.
    pub is_unknown_key: bool,
    /// What the key may be called there; empty unless the key is unknown.
    pub valid_keys: Vec<String>,
}

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
    C::Parameters::deserialize(read(checked))
        .is_ok_and(|parameters| C::may_restart(&parameters, role))
}

fn check_parameters<C: CaseStudy>(
    table: &toml::Table,
    seed: u64,
) -> Result<toml::Table, Vec<ParameterFault>> {
    check_parameters_with::<C>(table, seed, &mut |_| Ok(()))
}

/// The [`ParameterCheck`] of `C` with a step between reading and checking the parameters, for a
/// case whose parameters name files that someone must open for it.
///
/// Deserialises, lets the case check, and serialises again so that defaults become visible.
///
/// # Errors
/// Every parameter the case cannot read; else what `prepare` says, else what the case says.
pub fn check_parameters_with<C: CaseStudy>(
    table: &toml::Table,
    seed: u64,
    prepare: &mut dyn FnMut(&mut C::Parameters) -> Result<(), ParameterError>,
) -> Result<toml::Table, Vec<ParameterFault>> {
    let mut parameters = match C::Parameters::deserialize(read(table)) {
        Ok(parameters) => parameters,
        Err(error) => return Err(faults_of_each_key::<C>(table, &error)),
    };
    let complete = toml::Table::try_from(&parameters).map_err(|error| {
        vec![ParameterFault {
            key: Vec::new(),
            message: format!("cannot be written as TOML: {error}"),
            is_unknown_key: false,
            valid_keys: Vec::new(),
        }]
    })?;
    let checked = prepare(&mut parameters).and_then(|()| C::new(parameters, seed).map(drop));
    match checked {
        Ok(()) => Ok(complete),
        Err(error) => Err(vec![ParameterFault {
            key: error.key.split('.').map(str::to_owned).collect(),
            message: error.problem,
            is_unknown_key: false,
            valid_keys: Vec::new(),
        }]),
    }
}

/// Tries each key on its own, because a deserialiser stops at the first fault.
fn faults_of_each_key<C: CaseStudy>(table: &toml::Table, first: &ReadError) -> Vec<ParameterFault> {
    let single = |(key, value): (&String, &toml::Value)| {
        let alone = toml::Table::from_iter([(key.clone(), value.clone())]);
        let error = C::Parameters::deserialize(read(&alone)).err()?;
        // A case without defaults misses the other keys here; that is no fault of this key.
        (!error.is_missing_field()).then(|| error.to_fault())
    };
    let faults: Vec<_> = table.iter().filter_map(single).collect();
    if faults.is_empty() {
        vec![first.to_fault()]
    } else {
        faults
    }
}
