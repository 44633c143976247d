//! Declares structs of counters with an `iter()` over names and values, so that a report prints them
//! all without a list of its own. It holds no counter.

/// A struct of public `u64` counters, each stated once; what else it holds stands `beside`.
#[macro_export]
macro_rules! counts {
    (
        $(#[$about:meta])*
        pub struct $name:ident { $($(#[$doc:meta])* $field:ident,)+ }
        $(beside { $($(#[$other_doc:meta])* $other:ident: $type:ty,)+ })?
    ) => {
        $(#[$about])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
        pub struct $name {
            $($(#[$doc])* pub $field: u64,)+
            $($($(#[$other_doc])* pub $other: $type,)+)?
        }

        impl $name {
            /// Every counter with its name, zeros included, in the order of the fields.
            pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> + use<> {
                [$((stringify!($field), self.$field)),+].into_iter()
            }
        }
    };
}

/// Causes of a refusal, each with its name in a report and its message as an error, and a counter for
/// each of them.
macro_rules! causes {
    (
        $(#[$about:meta])* pub enum $cause:ident;
        $(#[$about_counts:meta])* pub struct $counts:ident;
        $($(#[$doc:meta])+ $variant:ident => $name:literal, $message:literal;)+
    ) => {
        $(#[$about])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
        pub enum $cause {
            $($(#[$doc])+ #[error($message)] $variant,)+
        }

        impl $cause {
            /// All of them, in the order of checking where there is one.
            pub const ALL: &'static [Self] = &[$(Self::$variant),+];

            /// In words, as reports print it.
            pub const fn name(self) -> &'static str {
                match self { $(Self::$variant => $name,)+ }
            }
        }

        $(#[$about_counts])*
        #[derive(Clone, Copy, PartialEq, Eq, Default)]
        pub struct $counts {
            counts: [u64; $cause::ALL.len()],
        }

        impl $counts {
            /// Counts one datagram.
            pub fn count(&mut self, cause: $cause) {
                self.counts[cause as usize] += 1;
            }

            /// How often `cause` happened.
            pub const fn get(&self, cause: $cause) -> u64 {
                self.counts[cause as usize]
            }

            /// Every counter with its name, zeros included, always in the same order.
            pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> + use<> {
                let counts = self.counts;
                let causes = $cause::ALL.iter();
                causes.map(move |&cause| (cause.name(), counts[cause as usize]))
            }

            /// Datagrams refused for any cause.
            pub fn total(&self) -> u64 {
                self.counts.iter().sum()
            }
        }

        impl core::fmt::Debug for $counts {
            fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
                let happened = self.iter().filter(|(_, count)| *count > 0);
                f.debug_map().entries(happened).finish()
            }
        }
    };
}

pub(crate) use causes;
