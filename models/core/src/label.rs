//! Enums whose variants have a word each.

/// Declares an enum with the word of each variant, which the method that is named gives, [`Display`] shows and
/// `ALL` lists; a number behind a variant is its discriminant.
///
/// [`Display`]: core::fmt::Display
///
/// ```
/// hil_core::labelled! {
///     /// What a door is.
///     #[derive(Debug, Clone, Copy, PartialEq)]
///     pub enum Door, word {
///         /// Nobody can pass.
///         Closed = "closed",
///         /// Everybody can.
///         Open: 7 = "wide open",
///     }
/// }
/// assert_eq!(Door::Open.word(), "wide open");
/// assert_eq!(Door::Open as u8, 7);
/// assert_eq!(Door::ALL.map(|door| door.to_string()), ["closed", "wide open"]);
/// ```
#[macro_export]
macro_rules! labelled {
    (@one $variant:ident) => { 1 };
    ($(#[$meta:meta])* $vis:vis enum $name:ident, $method:ident {
        $($(#[$about:meta])* $variant:ident $(: $number:tt)? = $label:literal,)+
    }) => {
        $(#[$meta])*
        $vis enum $name { $($(#[$about])* $variant $(= $number)?,)+ }

        #[allow(dead_code, reason = "not every enum is listed, or asked for its word but by `Display`")]
        impl $name {
            /// All of them, in order.
            $vis const ALL: [Self; { 0 $(+ $crate::labelled!(@one $variant))+ }] =
                [$(Self::$variant),+];

            /// Its word, as files and reports have it.
            $vis const fn $method(self) -> &'static str {
                match self { $(Self::$variant => $label,)+ }
            }
        }

        impl core::fmt::Display for $name {
            fn fmt(&self, formatter: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
                formatter.write_str(self.$method())
            }
        }
    };
}
