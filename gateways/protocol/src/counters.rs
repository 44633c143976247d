//! Gives a struct of counters an `iter()` over names and values, so that a report prints them all
//! without a list of its own. It holds no counter.

/// Implements `iter()`; a field that is left out does not compile.
macro_rules! named_counts {
    ($type:ty { $($field:ident),+ $(,)? } $(beside { $($other:ident),+ })?) => {
        impl $type {
            /// Every counter with its name, zeros included, in the order of the fields.
            pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> + use<> {
                let Self { $($field,)+ $($($other: _,)+)? } = *self;
                [$((stringify!($field), $field)),+].into_iter()
            }
        }
    };
}

pub(crate) use named_counts;
