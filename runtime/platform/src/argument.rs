//! Values on a command line, read the same way by every command.

/// Reads a whole number from `least` to `most`, and says the range in words when it is none.
pub fn whole<T>(least: u64, most: u64) -> impl Fn(&str) -> Result<T, String> + Clone
where
    T: TryFrom<u64>,
{
    move |text| {
        let number = text.parse::<u64>().ok();
        let number = number.filter(|number| (least..=most).contains(number));
        number
            .and_then(|number| T::try_from(number).ok())
            .ok_or_else(|| match most {
                u64::MAX => format!("must be a whole number, {least} or more"),
                _ => format!("must be a whole number from {least} to {most}"),
            })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_whole_number_outside_its_range_is_refused_with_it() {
        let port = whole::<u16>(1, 99);
        assert_eq!((port("1"), port("99")), (Ok(1), Ok(99)));
        for text in ["0", "100", "-1", "1.5", "", "many"] {
            let why = port(text).unwrap_err();
            assert_eq!(why, "must be a whole number from 1 to 99", "{text}");
        }
        let why = whole::<u64>(1, u64::MAX)("0").unwrap_err();
        assert_eq!(why, "must be a whole number, 1 or more");
    }
}
