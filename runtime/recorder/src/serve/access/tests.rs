//! Who is let in and who is not, and what is said of it.

use super::*;

const PAGE: u16 = 8766;

fn judged(host: &str, origin: Option<&str>) -> Result<(), Refusal> {
    let (hosts, origins) = (
        ["robot.example.org".to_owned()],
        ["https://app.foxglove.dev".to_owned()],
    );
    let access = Access::new(&hosts, &origins, Some("Control-PC.lab"));
    let head = Head {
        host: Some(host.to_owned()),
        origin: origin.map(str::to_owned),
        token: None,
    };
    access.judge(&head, PAGE)
}

fn foreign_origin(origin: &str) -> Result<(), Refusal> {
    Err(Refusal::ForeignOrigin(origin.to_owned()))
}

#[test]
fn programs_own_pages_and_allowed_pages_may_look_on() {
    for (host, origin) in [
        ("127.0.0.1:8765", None),
        ("localhost:8765", Some("http://localhost:8766")),
        ("LOCALHOST:8765", Some("http://localhost:8766")),
        ("127.0.0.1:8765", Some("http://127.0.0.1:8766")),
        ("[::1]:8765", Some("http://[::1]:8766")),
        ("192.168.0.7:8765", Some("http://192.168.0.7:8766")),
        ("control-pc:8765", Some("http://control-pc:8766")),
        ("control-pc.lab:8765", Some("http://control-pc.lab:8766")),
        // A tunnel may have another port for the socket; the page's stays.
        ("localhost:18765", Some("http://localhost:8766")),
        ("robot.example.org", Some("http://robot.example.org:8766")),
        ("localhost:8765", Some("https://app.foxglove.dev")),
        ("localhost", None),
        // As Python's websocket-client does.
        ("127.0.0.1:8765", Some("http://127.0.0.1:8765")),
    ] {
        assert_eq!(judged(host, origin), Ok(()), "{host} {origin:?}");
    }
}

#[test]
fn pages_of_others_may_not() {
    for origin in [
        "https://evil.example",
        "null",
        "file://",
        "",
        "http://localhost",
        "http://localhost:3000",
        "https://localhost:8766",
        "http://127.0.0.1:8766",
        "http://localhost:8766/",
        "http://localhost:8766.evil.example",
        "http://localhost:8766@evil.example",
        "https://app.foxglove.dev.evil.example",
        "http://app.foxglove.dev",
    ] {
        assert_eq!(
            judged("localhost:8765", Some(origin)),
            foreign_origin(origin)
        );
    }
}

#[test]
fn names_that_may_be_anybodys_are_refused_whoever_asks() {
    for name in [
        "evil.example",
        "localhost.evil.example",
        "127.0.0.1.evil.example",
        "control-pc.evil.example",
        "127.1",
    ] {
        let refused = Err(Refusal::ForeignHost(name.to_owned()));
        assert_eq!(judged(name, None), refused);
        let own = format!("http://{name}:8766");
        assert_eq!(judged(&format!("{name}:8765"), Some(&own)), refused);
    }
    for broken in [
        "",
        ":8765",
        "localhost:",
        "localhost:99999",
        "[::1",
        "a@localhost",
        "a b",
    ] {
        assert_eq!(judged(broken, None), Err(Refusal::Malformed), "{broken}");
    }
    let access = Access::new(&[], &[], None);
    let (host, origin) = (None, None);
    assert_eq!(
        access.judge(
            &Head {
                host,
                origin,
                token: None
            },
            PAGE
        ),
        Err(Refusal::NoHost)
    );
}

#[test]
fn a_page_on_the_port_of_the_web_has_none_in_its_origin() {
    let access = Access::new(&[], &[], None);
    let head = |origin: &str| Head {
        host: Some("127.0.0.1:8765".to_owned()),
        origin: Some(origin.to_owned()),
        token: None,
    };
    assert_eq!(access.judge(&head("http://127.0.0.1"), 80), Ok(()));
    assert!(access.judge(&head("http://127.0.0.1:80"), 80).is_err());
}

#[test]
fn each_refusal_is_said_once_and_all_are_counted() {
    let access = Access::new(&[], &[], None);
    assert_eq!(access.account(), None);
    let evil = Refusal::ForeignOrigin("https://evil.example".to_owned());
    for _attempt in 0..3 {
        access.count(&evil);
    }
    access.count(&Refusal::Full(32));
    let said = access.take_unsaid();
    assert_eq!(said.len(), 2, "{said:?}");
    assert!(
        said[0].contains("--allow-origin https://evil.example"),
        "{said:?}"
    );
    access.count(&evil);
    assert!(access.take_unsaid().is_empty());
    assert_eq!(
        access.account().unwrap(),
        "refused 5 requests: 4 × a page of https://evil.example; \
         1 × a viewer, as 32 look on already"
    );
    for index in 0..1000 {
        access.count(&Refusal::ForeignHost(format!("{index}.example")));
    }
    assert_eq!(access.take_unsaid().len(), NAMED_MAX - 2 + 1);
    let account = access.account().unwrap();
    assert!(
        account.starts_with("refused 1005 requests: 4 ×"),
        "{account}"
    );
    assert!(account.ends_with("; 994 others"), "{account}");
}

#[test]
fn foreign_words_are_short_and_leave_the_terminal_alone() {
    assert_eq!(word("http://\u{1b}[31m\u{9b}x\n"), "http://?[31m?x?");
    assert_eq!(word(&"a".repeat(5000)).len(), WORD_MAX + 3);
}

#[test]
fn the_command_line_names_origins_and_hosts() {
    assert_eq!(
        origin("https://App.foxglove.dev/").unwrap(),
        "https://app.foxglove.dev"
    );
    assert_eq!(
        origin("http://localhost:9000").unwrap(),
        "http://localhost:9000"
    );
    assert_eq!(origin("file://").unwrap(), "file://");
    for wrong in [
        "*",
        "app.foxglove.dev",
        "https://",
        "https://a/b",
        "https://a:b",
        "://a",
    ] {
        assert!(origin(wrong).is_err(), "{wrong}");
    }
    assert_eq!(host("Robot.example.org.").unwrap(), "robot.example.org");
    for wrong in ["", "*", "robot:8765", "http://robot", "a b"] {
        assert!(host(wrong).is_err(), "{wrong}");
    }
}

#[test]
fn a_file_looks_on_only_where_that_was_asked_for() {
    let head = Head {
        host: Some("localhost:8765".to_owned()),
        origin: Some("file://".to_owned()),
        token: None,
    };
    let refusal = Access::new(&[], &[], None).judge(&head, PAGE).unwrap_err();
    let words = refusal.words();
    assert!(
        words.contains("--allow-origin file:// lets them all"),
        "{words}"
    );
    let allowed = [origin("file://").unwrap()];
    assert_eq!(Access::new(&[], &allowed, None).judge(&head, PAGE), Ok(()));
}

#[test]
fn no_command_is_offered_that_would_do_more_than_let_somebody_in() {
    let said = |origin: &str| Refusal::ForeignOrigin(word(origin)).words();
    assert!(said("http://[::2]:80").contains("--allow-origin 'http://[::2]:80' lets"));
    for origin in [
        "http://$(reboot)",
        "http://a;reboot",
        "http://`reboot`",
        "http://a&reboot",
        "http://a'b",
        "http://a\"b",
        "http://a|b",
        "http://a>b",
        "http://a b",
        "http://a\n--record=b",
        "-x://a",
        "",
        // Cut short, it would name another.
        &format!("http://{}", "a".repeat(WORD_MAX)),
    ] {
        let words = said(origin);
        assert!(!words.contains("--allow-origin"), "{words}");
        assert!(words.starts_with("refused a page of "), "{words}");
    }
    for host in ["-x", "$(reboot)", "a;b"] {
        let words = Refusal::ForeignHost(word(host)).words();
        assert!(!words.contains("--allow-host"), "{words}");
        assert!(words.contains("not this machine's name"), "{words}");
    }
}

#[test]
fn who_is_not_this_user_needs_the_token_and_who_has_it_is_no_page_of_others() {
    let token = Token::draw().unwrap();
    let right = token.to_string().replace("?token=", "");
    assert_eq!(right.len(), 32);
    assert_ne!(
        right,
        Token::draw().unwrap().to_string().replace("?token=", "")
    );
    let access = Access::new(&[], &[], None).with_token(token);
    let admitted = |token: Option<&str>, origin: Option<&str>, is_own: bool| {
        let head = Head {
            host: Some("localhost:8765".to_owned()),
            origin: origin.map(str::to_owned),
            token: token.map(str::to_owned),
        };
        access.admit(&head, PAGE, || is_own)
    };
    assert_eq!(admitted(Some(&right), None, false), Ok(()));
    assert_eq!(admitted(None, None, true), Ok(()));
    let longer = format!("{right}0");
    for wrong in [None, Some(""), Some("0"), Some(&right[1..]), Some(&longer)] {
        assert_eq!(
            admitted(wrong, None, false),
            Err(Refusal::NoToken),
            "{wrong:?}"
        );
        assert_eq!(admitted(wrong, None, true), Ok(()));
    }
    let evil = Some("https://evil.example");
    assert!(matches!(
        admitted(Some(&right), evil, true),
        Err(Refusal::ForeignOrigin(_))
    ));
    let said = format!("{access:?} {}", Refusal::NoToken.words());
    assert!(!said.contains(&right), "{said}");
    // Without one, only this user.
    let access = Access::new(&[], &[], None);
    let head = Head {
        host: Some("localhost".to_owned()),
        token: Some(String::new()),
        ..Head::default()
    };
    assert_eq!(access.admit(&head, PAGE, || false), Err(Refusal::NoToken));
}
