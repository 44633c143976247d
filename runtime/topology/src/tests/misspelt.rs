//! A misspelt key is refused wherever it stands.

use super::*;

/// Paths of all keys that are words of the format, in tables the file has.
fn fixed_keys(table: &toml::Table, path: &[String], found: &mut Vec<Vec<String>>) {
    let first = path.first().map(String::as_str);
    let is_named_by_user = path.len() == 1
        && matches!(first, Some("hosts" | "processes" | "channels" | "links"))
        || path.last().is_some_and(|key| key == "env");
    for (key, value) in table {
        let mut path = path.to_vec();
        path.push(key.clone());
        if let toml::Value::Table(below) = value {
            fixed_keys(below, &path, found);
        }
        if !is_named_by_user {
            found.push(path);
        }
    }
}

fn table_at<'t>(table: &'t mut toml::Table, path: &[String]) -> &'t mut toml::Table {
    path.iter()
        .fold(table, |table, key| table[key].as_table_mut().unwrap())
}

#[test]
fn a_misspelt_key_anywhere_is_refused_with_the_right_one() {
    let good = parse_good(EVERYTHING).resolved();
    let mut keys = Vec::new();
    fixed_keys(&good, &[], &mut keys);
    assert!(keys.len() > 100, "{}", keys.len());
    for path in keys {
        let (right, parent) = path.split_last().unwrap();
        let mut swapped: Vec<char> = right.chars().collect();
        swapped.swap(0, 1);
        let doubled = format!("{right}{}", right.chars().last().unwrap());
        for wrong in [doubled, swapped.into_iter().collect()] {
            let mut text = good.clone();
            let table = table_at(&mut text, parent);
            let value = table[right].clone();
            table.insert(wrong.clone(), value);
            let text = toml::to_string(&text).unwrap();
            let errors = parse("misspelt.toml", &text, &[], &known()).expect_err(&wrong);
            let [error] = errors.errors() else {
                panic!("{wrong}: {errors}");
            };
            assert!(matches!(error.fault, Fault::UnknownKey { .. }), "{errors}");
            let suggestion = format!("did you mean `{right}`?");
            assert!(error.to_string().contains(&suggestion), "{wrong}: {errors}");
            let line = error.location.as_ref().unwrap().line;
            assert!(
                text.lines().nth(line - 1).unwrap().contains(&wrong),
                "{errors}"
            );
        }
    }
}
