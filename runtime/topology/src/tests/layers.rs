//! Chains of files: what merges, and where a fault in a lower file points.

use std::fs;

use super::*;

/// A folder that is removed again.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let folder =
            std::env::temp_dir().join(format!("hil-topology-{}-{name}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        Self(folder)
    }

    fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.0.join(name);
        fs::write(&path, text).unwrap();
        path
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        fs::remove_dir_all(&self.0).ok();
    }
}

#[test]
fn a_chain_of_files_merges_tables_and_replaces_arrays() {
    let folder = Folder::new("chain");
    folder.write(
        "base.toml",
        "version = 1\nname = 'base'\n[case]\nname = 'shuttle'\n[processes]\n\
         controller = { role = 'controller', cpu = [1, 2, 3], wait = 'hybrid' }\n\
         robot = { role = 'robot' }\n",
    );
    folder.write(
        "middle.toml",
        "extends = 'base.toml'\nname = 'middle'\nrun.seed = 5\n",
    );
    let top = folder.write(
        "top.toml",
        "extends = './middle.toml'\n[processes.controller]\ncpu = [4]\n",
    );
    let topology = load(&top, &[], &known()).unwrap();
    assert_eq!(topology.name(), "middle");
    assert_eq!(topology.run().seed, 5);
    let controller = topology.process("controller").unwrap();
    assert_eq!(controller.execution.cpu, [4]);
    assert_eq!(controller.execution.wait, Wait::Hybrid);
}

#[test]
fn a_fault_in_a_base_file_points_into_that_file() {
    let folder = Folder::new("spans");
    folder.write(
        "base.toml",
        "version = 1\nname = 'base'\n[case]\nname = 'shuttle'\n[processes.robot]\n\
         role = 'robot'\nwiat = 'block'\n",
    );
    let top = folder.write(
        "top.toml",
        "extends = 'base.toml'\n[processes.controller]\nrole = 'controler'\n",
    );
    let set = ["run.seed=-1".to_owned()];
    let errors = load(&top, &set, &known()).unwrap_err();
    let seen: Vec<_> = errors
        .errors()
        .iter()
        .map(|error| {
            let location = error.location.as_ref().unwrap();
            let file = Path::new(&location.file).file_name().unwrap();
            let file = file.to_str().unwrap().to_owned();
            (error.key.as_str(), file, location.line, location.column)
        })
        .collect();
    assert_eq!(
        seen,
        [
            ("processes.controller.role", "top.toml".to_owned(), 3, 8),
            ("processes.robot.wiat", "base.toml".to_owned(), 7, 1),
            ("run.seed", "--set".to_owned(), 1, 10),
        ]
    );
    let rendered = errors.render(false);
    assert!(rendered.contains("base.toml:7:1"), "{rendered}");
    assert!(rendered.contains("wiat = 'block'"), "{rendered}");
    assert!(rendered.contains("did you mean `wait`?"), "{rendered}");
    assert!(errors.render(true).contains("\u{1b}["));
}

#[test]
fn of_a_file_that_is_no_topology_only_the_first_errors_are_told() {
    let folder = Folder::new("no-topology");
    let path = folder.write("main.out", &"what a program printed\n".repeat(40));
    let errors = load(&path, &[], &known()).unwrap_err();
    let count = errors.errors().len();
    assert!(count > 10, "{errors}");
    let end = format!("\nand {} more", count - 10);
    let rendered = errors.render(false);
    assert!(rendered.ends_with(&end), "{rendered}");
    assert_eq!(rendered.matches("error: ").count(), 10, "{rendered}");
    let lines = errors.to_string();
    assert!(lines.ends_with(&end), "{lines}");
    assert_eq!(lines.lines().count(), 11, "{lines}");
}

#[test]
fn files_that_extend_each_other_in_a_circle_are_refused() {
    let folder = Folder::new("cycle");
    let a = folder.write("a.toml", "version = 1\nextends = 'b.toml'\n");
    folder.write("b.toml", "extends = 'a.toml'\n");
    let errors = load(&a, &[], &known()).unwrap_err();
    let [error] = errors.errors() else {
        panic!("{errors}");
    };
    assert!(matches!(&error.fault, Fault::ExtendsCycle(chain) if chain.len() == 3));
    let location = error.location.as_ref().unwrap();
    assert!(location.file.ends_with("b.toml"));
    assert_eq!(location.line, 1);
}

#[test]
fn a_file_that_is_not_there_is_named_where_it_is_asked_for() {
    let folder = Folder::new("absent");
    let top = folder.write("top.toml", "name = 'x'\nextends = 'nowhere.toml'\n");
    let errors = load(&top, &[], &known()).unwrap_err();
    let text = errors.to_string();
    assert!(text.contains("top.toml:2:11: extends"), "{text}");
    assert!(
        text.contains("nowhere.toml cannot be read: No such file"),
        "{text}"
    );
    let errors = load(&folder.0.join("none.toml"), &[], &known()).unwrap_err();
    assert!(errors.errors()[0].location.is_none());
    assert!(errors.render(false).contains("none.toml cannot be read"));
}
