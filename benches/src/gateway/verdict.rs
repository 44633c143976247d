//! Aims and whether they were met, as text for people and one JSON line for machines.

use serde_json::{Value, json};

/// One aim against what was measured.
#[derive(Debug, Clone)]
pub struct Verdict {
    /// What is judged.
    pub name: String,
    /// What was measured; `None` where it could not be.
    pub measured: Option<f64>,
    /// At most this.
    pub aim_max: f64,
    /// Unit of both, or why nothing was measured.
    pub note: String,
}

impl Verdict {
    /// `PASS`, `FAIL` or that it cannot be said here.
    pub fn word(&self) -> &'static str {
        match self.measured {
            Some(measured) if measured <= self.aim_max => "PASS",
            Some(_) => "FAIL",
            None => "not measurable here",
        }
    }

    /// One line for people.
    pub fn text(&self) -> String {
        let Self {
            name,
            measured,
            aim_max,
            note,
        } = self;
        let word = self.word();
        match measured {
            Some(measured) => {
                format!("{word:<5} {name}: {measured:.3} {note}, aim at most {aim_max} {note}")
            }
            None => format!("{word}: {name} ({note})"),
        }
    }

    /// One line for machines.
    pub fn json_line(&self, bench: &str) -> String {
        json!({
            "bench": bench,
            "aim": self.name,
            "measured": self.measured.map_or(Value::Null, |measured| json!(measured)),
            "aim_max": self.aim_max,
            "verdict": self.word(),
            "note": self.note,
        })
        .to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_not_measured_is_neither_met_nor_missed() {
        let verdict = |measured| Verdict {
            name: "hop".to_owned(),
            measured,
            aim_max: 1.1,
            note: "x".to_owned(),
        };
        assert_eq!(verdict(Some(1.1)).word(), "PASS");
        assert_eq!(verdict(Some(1.2)).word(), "FAIL");
        assert!(verdict(None).text().starts_with("not measurable here"));
        assert!(verdict(None).json_line("b").contains("\"measured\":null"));
    }
}
