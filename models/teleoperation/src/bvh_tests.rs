//! Tests of [`super`].

use super::*;

const SMALL: &str = "HIERARCHY\nROOT Hips\n{\n  OFFSET 0 0 0\n  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation\n  JOINT RightHand\n  {\n    OFFSET -50 40 0\n    CHANNELS 3 Yrotation Xrotation Zrotation\n    End Site\n    {\n      OFFSET -10 0 0\n    }\n  }\n}\nMOTION\nFrames: 2\nFrame Time: 0.008\n0 95 0 0 0 0 1 2 3\n0 95 0 0 0 0 1.5 -2e1 3\n";

fn parsed(text: &str) -> Result<Bvh, BvhError> {
    Bvh::parse(&text.into())
}

#[track_caller]
fn check_error(text: &str, line: u64, message: &str) {
    let error = parsed(text).unwrap_err();
    assert_eq!(error.line, line, "{error}");
    assert!(error.to_string().contains(message), "{error}");
}

#[test]
fn a_small_file_is_read_as_written() {
    let bvh = parsed(SMALL).unwrap();
    assert_eq!(bvh.frame_count(), 2);
    assert_eq!(bvh.skeleton.channel_count(), 9);
    assert_eq!(bvh.skeleton.joints()[1].parent, Some(0));
    assert_eq!(bvh.frames().count(), 2);
    assert!((bvh.values[16] + 20.0).abs() < 1e-15);
    assert_eq!(parsed(&bvh.to_text()).unwrap(), bvh);
}

#[test]
fn windows_line_ends_and_a_byte_order_mark_change_nothing() {
    let windows = format!("\u{feff}{}", SMALL.replace('\n', "\r\n"));
    let windows = TextFile::decode(windows.as_bytes()).unwrap();
    assert_eq!(Bvh::parse(&windows), parsed(SMALL));
    let without_blanks = SMALL.replace("s: 2", "s:2").replace("e: 0", "e:0");
    assert_eq!(parsed(&without_blanks), parsed(SMALL));
}

#[test]
fn errors_name_line_and_cause() {
    check_error("", 1, "expected the keyword HIERARCHY");
    check_error(
        &SMALL.replace("-50", "west"),
        8,
        "\"west\" is not an offset",
    );
    check_error(&SMALL.replace("0.008", "0,008"), 18, "decimal comma");
    check_error(&SMALL.replace("1.5", "1,5"), 20, "decimal comma");
    check_error(&SMALL.replace("Yrotation X", "Yaw X"), 9, "channel name");
    check_error(&SMALL.replace("0.008", "0"), 18, "frame time 0 is outside");
    check_error(&SMALL.replace("-2e1", "NaN"), 20, "a channel value");
    check_error(&SMALL.replace("CHANNELS 3", "CHANNELS 7"), 9, "0 to 6");
    check_error(&SMALL[..60], 5, "the end of the text");
    let without = &SMALL[..SMALL.find("0 95").unwrap()];
    check_error(without, 18, "no whole frame: 9 values make one, 0 found");
    let offset = parsed(&SMALL.replace("-50", "west")).unwrap_err().offset;
    assert_eq!(offset, SMALL.find("    OFFSET -50").unwrap() as u64);
}

#[test]
fn whole_frames_are_played_whatever_was_announced() {
    assert_eq!(parsed(SMALL).unwrap().remark(), None);
    for (text, found) in [
        (SMALL.replace(": 2", ": 3"), 2),
        (SMALL.replace(": 2", ": 1"), 2),
        (SMALL.replace(": 2", ": 18446744073709551615"), 2),
        (SMALL.replace(" -2e1 3", ""), 1),
    ] {
        let bvh = parsed(&text).unwrap();
        assert_eq!(bvh.frame_count(), found);
        let remark = bvh.remark().unwrap();
        assert!(remark.contains(&format!("{found} whole ones")), "{remark}");
    }
}

#[test]
fn a_cut_last_frame_is_told_of_also_when_the_counts_agree() {
    for (announced, values) in [(2, "1 2"), (1, "1"), (2, "4")] {
        let text = SMALL.replace(": 2", &format!(": {announced}"));
        let bvh = parsed(&format!("{}\n{values}\n", text.trim_end())).unwrap();
        let count = values.split(' ').count();
        assert_eq!((bvh.frame_count(), bvh.cut_count), (2, count));
        let remark = bvh.remark().unwrap();
        let told = format!("{count} values behind the last one");
        assert!(remark.contains(&told), "{remark}");
    }
}

#[test]
fn a_line_of_another_count_among_lines_of_a_frame_each_is_a_fault() {
    let frame = "0 95 0 0 0 0 1 2 3\n";
    let start = &SMALL[..SMALL.find("0 95").unwrap()];
    let of = |announced: usize, lines: &[&str]| {
        let start = start.replace(": 2", &format!(": {announced}"));
        parsed(&(start + &lines.concat()))
    };
    let [short, long] = ["0 95 0 0 0 0 1 2\n", "0 95 0 0 0 0 1 2 3 4\n"];
    for (announced, lines, line) in [
        (4, [frame, short, frame, long], 20),
        (4, [frame, long, frame, frame], 20),
        (9, [frame, frame, frame, long], 22),
        // One value less on every line, as by a channel that the skeleton should not have.
        (4, [short, short, short, short], 19),
    ] {
        let error = of(announced, &lines).unwrap_err();
        assert_eq!(error.line, line, "{error}");
        assert!(
            error.to_string().contains("where a line is a frame of 9"),
            "{error}"
        );
    }
    // A file that is still being written, and values spread over lines at will.
    assert_eq!(of(4, &[frame, frame, frame, short]).unwrap().cut_count, 8);
    let spread = of(
        2,
        &[
            "0 95 0\n",
            "0 0 0\n",
            "1 2 3 0 95 0 0\n",
            "0 0\n",
            "1 2\n",
            "3\n",
        ],
    );
    assert_eq!(spread.unwrap().frame_count(), 2);
    let both = of(2, &["0 95 0 0 0 0 1 2 3 0 95 0 0 0 0 1 2 3\n"]).unwrap();
    assert_eq!((both.frame_count(), both.cut_count), (2, 0));
}

#[test]
fn what_programs_write_otherwise_changes_nothing() {
    for (here, there) in [
        ("Frames:", "Frames :"),
        ("Frames: 2", "Frames: 2.0"),
        ("Frame Time:", "Frame Time :"),
        ("Frame Time: ", "Frame Time :"),
        ("End Site", "EndSite"),
        ("End Site", "End Site RightHandEnd"),
        ("End Site\n    {", "EndSite Tip {"),
        ("HIERARCHY", "# made by hand\nHIERARCHY"),
        ("MOTION", "  # motion\nMOTION"),
        ("0.008\n", "0.008\n# frames: 2\n"),
    ] {
        assert_eq!(
            parsed(&SMALL.replace(here, there)),
            parsed(SMALL),
            "{there}"
        );
    }
    for end in [&b"\x1a"[..], b"\0\0\0"] {
        let filled = TextFile::decode(&[SMALL.as_bytes(), end].concat()).unwrap();
        assert_eq!(Bvh::parse(&filled), parsed(SMALL));
    }
    let second = SMALL.replace("MOTION", "ROOT Prop\n{\n}\nMOTION");
    check_error(&second, 16, "a second ROOT: one skeleton is read");
}

#[test]
fn a_name_is_the_rest_of_its_line_in_any_encoding() {
    let spaced = SMALL.replace("JOINT RightHand\n  {", "JOINT Bip01 R Hand {");
    let bvh = parsed(&spaced).unwrap();
    assert_eq!(bvh.skeleton.joints()[1].name, "Bip01 R Hand");
    assert_eq!(bvh.values, parsed(SMALL).unwrap().values);
    let latin1 = SMALL.replace("Hips", "H?fte").replace('?', "\u{fc}");
    let bytes: Vec<u8> = latin1
        .chars()
        .map(|letter| u8::try_from(u32::from(letter)).unwrap())
        .collect();
    let bvh = Bvh::parse(&TextFile::decode(&bytes).unwrap()).unwrap();
    assert_eq!(bvh.skeleton.joints()[0].name, "H\u{fc}fte");
}

#[test]
fn deep_nesting_ends_in_an_error_not_in_an_overflow() {
    let joint = "JOINT a { OFFSET 0 0 0 CHANNELS 0 ";
    let deep = format!(
        "HIERARCHY\nROOT{}",
        joint[5..].to_owned() + &joint.repeat(5000)
    );
    check_error(&deep, 2, "joint count 1025 is outside 1 to 1024");
}
