//! Figures that there are none of for one and the same reason: the reason is said once, with what it
//! concerns.

/// Labels as one text. Of labels that begin alike, up to their last comma, only the ends are repeated:
/// `network, one way, p50, p99; jitter, mean`.
pub fn joined_labels(labels: &[&str]) -> String {
    let mut text = String::new();
    let mut before = None;
    for label in labels {
        let begin = label.rsplit_once(", ");
        match (begin, before) {
            (Some((begin, end)), Some(last)) if begin == last => {
                text.push_str(", ");
                text.push_str(end);
            }
            _ => {
                if !text.is_empty() {
                    text.push_str("; ");
                }
                text.push_str(label);
            }
        }
        before = begin.map(|(begin, _)| begin);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_labels_have_in_common_is_said_once() {
        let labels = [
            "published → taken, p50",
            "published → taken, p99",
            "network, one way, p50",
            "network, one way, largest",
            "jitter",
        ];
        assert_eq!(
            joined_labels(&labels),
            "published → taken, p50, p99; network, one way, p50, largest; jitter"
        );
        assert_eq!(joined_labels(&["one"]), "one");
        assert_eq!(joined_labels(&[]), "");
    }
}
