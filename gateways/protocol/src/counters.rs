//! Declares a struct of counters with an `iter()` over names and values, so that a report prints them
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
