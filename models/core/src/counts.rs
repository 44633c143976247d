//! Counts of runs that add up to those of all.

/// Declares a struct of counts with `merge`. A line is `name: type;`, with `=> function` behind the type
/// where two runs together do not have the sum.
///
/// ```
/// hil_core::counts! {
///     /// What two robots did.
///     pub struct Driven {
///         /// Missions done.
///         done_count: u64;
///         /// Farthest stop past a goal, metres.
///         error_max_m: f64 => f64::max;
///     }
/// }
/// let mut all = Driven { done_count: 2, error_max_m: 0.1 };
/// all.merge(&Driven { done_count: 3, error_max_m: 0.3 });
/// assert_eq!(all, Driven { done_count: 5, error_max_m: 0.3 });
/// ```
#[macro_export]
macro_rules! counts {
    (@add $mine:expr, $other:expr) => { $mine += $other };
    (@add $mine:expr, $other:expr, $merge:expr) => { $mine = ($merge)($mine, $other) };
    ($(#[$meta:meta])* pub struct $name:ident {
        $($(#[$about:meta])* $field:ident: $kind:ty $(=> $merge:expr)?;)*
    }) => {
        #[derive(Debug, Clone, Copy, PartialEq, Default)]
        $(#[$meta])*
        pub struct $name { $($(#[$about])* pub $field: $kind,)* }

        impl $name {
            /// Adds what another run counted.
            pub fn merge(&mut self, other: &Self) {
                $($crate::counts!(@add self.$field, other.$field $(, $merge)?);)*
            }
        }
    };
}
