//! Laws of a link, of which a table names one: the enum of them, and its options.

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

            /// Checks every option.
            ///
            /// # Errors
            /// The first key that is refused.
            pub fn check(&self) -> Result<(), hil_core::case_study::ParameterError> {
                hil_core::options::Options::check_all(&mut self.clone())
            }

            fn law(&self) -> &dyn $law {
                match self { $(Self::$variant(law) => law,)* }
            }
        }

        /// Those of the law.
        impl hil_core::options::Options for $name {
            fn fields(&mut self) -> Vec<hil_core::options::Field<'_>> {
                match self { $(Self::$variant(law) => law.fields(),)* }
            }

            fn check_together(&self) -> Result<(), hil_core::case_study::ParameterError> {
                self.law().check_together()
            }
        }
    };
}

pub(crate) use laws;
