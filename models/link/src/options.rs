//! Options of the parts of a link as data. A part states each of its options once, with type, default
//! and range; its checks, the reader and the writer of topology files, their JSON schema and the
//! tables of fits run from that.

use core::fmt::Debug;
use core::ops::RangeInclusive;
use core::time::Duration;

use hil_core::case_study::ParameterError;

/// The place of an option's value, with the values allowed there.
#[derive(Debug)]
pub enum Slot<'o> {
    /// A time.
    Duration(&'o mut Duration, RangeInclusive<Duration>),
    /// A time that the part keeps as a number of seconds, under its key with `_s` behind.
    Seconds(&'o mut f64, RangeInclusive<Duration>),
    /// A real number.
    Number(&'o mut f64, RangeInclusive<f64>),
    /// An integer.
    Integer(&'o mut u64, RangeInclusive<u64>),
    /// A small integer.
    Count(&'o mut u32, RangeInclusive<u32>),
    /// True or false.
    Boolean(&'o mut bool),
    /// One word of a list.
    Word(&'o mut dyn Word),
    /// Times, each in the range.
    Durations(&'o mut Vec<Duration>, RangeInclusive<Duration>),
    /// Real numbers, each in the range.
    Numbers(&'o mut Vec<f64>, RangeInclusive<f64>),
    /// Options of a part of this part.
    Table(&'o mut dyn Options),
}

/// One option of a part.
#[derive(Debug)]
pub struct Field<'o> {
    /// Its key.
    pub key: &'static str,
    /// True when it has no default.
    pub is_required: bool,
    /// What to write, for whoever left it out.
    pub hint: &'static str,
    /// Its value.
    pub slot: Slot<'o>,
}

impl Field<'_> {
    /// Checks the value against its range.
    ///
    /// # Errors
    /// When it is outside.
    pub fn check(self) -> Result<(), ParameterError> {
        fn within<T: PartialOrd>(
            key: &str,
            values: &[T],
            range: &RangeInclusive<T>,
            text: fn(&T) -> String,
        ) -> Result<(), ParameterError> {
            let Some(value) = values.iter().find(|value| !range.contains(value)) else {
                return Ok(());
            };
            let [value, low, high] = [value, range.start(), range.end()].map(text);
            let problem = format!("{value} is outside {low} to {high}");
            Err(ParameterError::new(key, problem))
        }
        let time_text = |time: &Duration| format!("{time:?}");
        let seconds = |time: &Duration| time.as_secs_f64();
        match self.slot {
            Slot::Duration(value, range) => within(self.key, &[*value], &range, time_text),
            Slot::Seconds(value, range) => {
                let range = seconds(range.start())..=seconds(range.end());
                within(
                    &format!("{}_s", self.key),
                    &[*value],
                    &range,
                    f64::to_string,
                )
            }
            Slot::Number(value, range) => within(self.key, &[*value], &range, f64::to_string),
            Slot::Integer(value, range) => within(self.key, &[*value], &range, u64::to_string),
            Slot::Count(value, range) => within(self.key, &[*value], &range, u32::to_string),
            Slot::Durations(values, range) => within(self.key, values, &range, time_text),
            Slot::Numbers(values, range) => within(self.key, values, &range, f64::to_string),
            Slot::Boolean(_) | Slot::Word(_) => Ok(()),
            Slot::Table(options) => options.check_all(),
        }
    }
}

/// A part that has options.
pub trait Options: Debug {
    /// All options, in the order of their declaration.
    fn fields(&mut self) -> Vec<Field<'_>>;

    /// Checks what the options say together; each is within its range by then.
    ///
    /// # Errors
    /// The first key that does not fit the others.
    fn check_together(&self) -> Result<(), ParameterError> {
        Ok(())
    }

    /// Checks every option against its range, then all together.
    ///
    /// # Errors
    /// The first key that is refused.
    fn check_all(&mut self) -> Result<(), ParameterError> {
        self.fields().into_iter().try_for_each(Field::check)?;
        self.check_together()
    }
}

/// An option that is one word of a list.
pub trait Word: Debug {
    /// All words.
    fn words(&self) -> &'static [&'static str];
    /// Its own.
    fn word(&self) -> &'static str;
    /// Sets it to the word at `index` of the list.
    fn set(&mut self, index: usize);
}

/// A type of options.
pub trait Kind {
    /// The range that a declaration states for it.
    type Range;
    /// Value of an option without a default until it is set.
    const UNSET: Self;
    /// What to write, for whoever left it out.
    const HINT: &'static str;

    /// The value in its slot.
    fn slot(&mut self, range: Self::Range) -> Slot<'_>;
}

macro_rules! kinds {
    ($($kind:ty, $range:ty, $slot:ident, $unset:expr, $hint:literal;)*) => {$(
        impl Kind for $kind {
            type Range = RangeInclusive<$range>;
            const UNSET: Self = $unset;
            const HINT: &'static str = $hint;

            fn slot(&mut self, range: Self::Range) -> Slot<'_> {
                Slot::$slot(self, range)
            }
        }
    )*};
}

kinds! {
    Duration, Duration, Duration, Self::ZERO, "a duration, e.g. \"20 ms\"";
    f64, f64, Number, 0.0, "a number";
    u64, u64, Integer, 0, "an integer, e.g. 10_000_000";
    u32, u32, Count, 0, "an integer";
    Vec<Duration>, Duration, Durations, Self::new(), "an array of durations";
    Vec<f64>, f64, Numbers, Self::new(), "an array of numbers";
}

/// Declares the options of a part: its struct, their checks and [`Options`]. A line is
/// `key: type = default, in range, hint "what to write";` and what does not apply is left out; an
/// option without a default is required. `check` names what else is checked.
macro_rules! options {
    (@or $value:expr) => { $value };
    (@or $default:expr, $value:expr) => { $value };
    ($(#[$meta:meta])* pub struct $name:ident {
        $($(#[$about:meta])* $key:ident: $kind:ty $(= $default:expr)? $(, in $range:expr)?
            $(, hint $hint:literal)?;)*
    } $(check $check:path;)?) => {
        #[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
        #[serde(deny_unknown_fields)]
        $(#[$meta])*
        pub struct $name { $($(#[$about])* pub $key: $kind,)* }

        impl $name {
            /// Every option at its default; those that are required are unset.
            pub const TEMPLATE: Self = Self {
                $($key: $crate::options::options!(
                    @or <$kind as $crate::options::Kind>::UNSET $(, $default)?
                ),)*
            };

            /// Checks every option.
            ///
            /// # Errors
            /// The first key that is refused.
            pub fn check(&self) -> Result<(), hil_core::case_study::ParameterError> {
                $crate::options::Options::check_all(&mut self.clone())
            }
        }

        impl $crate::options::Options for $name {
            fn fields(&mut self) -> Vec<$crate::options::Field<'_>> {
                vec![$($crate::options::Field {
                    key: stringify!($key),
                    is_required: <[&str]>::is_empty(&[$(stringify!($default))?]),
                    hint: $crate::options::options!(
                        @or <$kind as $crate::options::Kind>::HINT $(, $hint)?
                    ),
                    slot: $crate::options::Kind::slot(
                        &mut self.$key,
                        $crate::options::options!(@or () $(, $range)?),
                    ),
                },)*]
            }

            $(fn check_together(&self) -> Result<(), hil_core::case_study::ParameterError> {
                $check(self)
            })?
        }
    };
}

/// Declares an option that is one word of a list: its enum, with the word of each variant.
macro_rules! words {
    ($(#[$meta:meta])* pub enum $name:ident {
        $($(#[$about:meta])* $variant:ident = $word:literal,)*
    }) => {
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
        $(#[$meta])*
        pub enum $name { $($(#[$about])* #[serde(rename = $word)] $variant,)* }

        impl $crate::options::Word for $name {
            fn words(&self) -> &'static [&'static str] {
                &[$($word),*]
            }

            fn word(&self) -> &'static str {
                match self { $(Self::$variant => $word,)* }
            }

            fn set(&mut self, index: usize) {
                *self = [$(Self::$variant),*][index];
            }
        }

        impl $crate::options::Kind for $name {
            type Range = ();
            const UNSET: Self = [$(Self::$variant),*][0];
            const HINT: &'static str = "a word";

            fn slot(&mut self, (): ()) -> $crate::options::Slot<'_> {
                $crate::options::Slot::Word(self)
            }
        }
    };
}

/// Declares the laws of one kind: an enum with the name of each in files. A line is
/// `Struct = "name",`.
macro_rules! laws {
    ($(#[$meta:meta])* pub enum $name:ident: $law:ident {
        $($(#[$about:meta])* $variant:ident = $word:literal,)*
    }) => {
        #[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
        $(#[$meta])*
        #[serde(tag = "law")]
        pub enum $name { $($(#[$about])* #[serde(rename = $word)] $variant($variant),)* }

        impl $name {
            /// Names of all laws.
            pub const NAMES: &'static [&'static str] = &[$($word),*];

            /// The law called `name`, with every option at its default.
            pub fn named(name: &str) -> Option<Self> {
                match name {
                    $($word => Some(Self::$variant($variant::TEMPLATE)),)*
                    _ => None,
                }
            }

            /// Its name.
            pub const fn name(&self) -> &'static str {
                match self { $(Self::$variant(_) => $word,)* }
            }

            /// Its options.
            pub fn options(&mut self) -> &mut dyn $crate::options::Options {
                match self { $(Self::$variant(law) => law,)* }
            }

            /// Checks every option.
            ///
            /// # Errors
            /// The first key that is refused.
            pub fn check(&self) -> Result<(), hil_core::case_study::ParameterError> {
                self.clone().options().check_all()
            }

            fn law(&self) -> &dyn $law {
                match self { $(Self::$variant(law) => law,)* }
            }
        }
    };
}

pub(crate) use laws;
pub(crate) use options;
pub(crate) use words;
