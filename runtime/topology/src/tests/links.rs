//! What an emulated link can be told to do: every law, its inheritance, its way back to a file, and
//! its faults.

use hil_core::options::{Options as _, Shape, Slot};
use hil_link::delay::{Exponential, Histogram, LogNormal, Normal, Pareto, Uniform};
use hil_link::loss::{Bursts, GilbertElliott};
use hil_link::rate::RateLimit;
use hil_link::reordering::{Duplication, Reordering};

use super::*;

/// `below` as the tables of an emulated link.
fn with_link(below: &str) -> String {
    let emulated = format!("via = \"emulated\"\n{below}");
    faulty::GOOD.replace("via = \"udp\"", &emulated)
}

/// What the link does forward, after it went through the resolved form as well.
fn specs(below: &str) -> (LinkSpec, LinkSpec) {
    let topology = parse_good(&with_link(below));
    let again = parse("again.toml", &topology.to_toml(), &[], &known());
    assert_eq!(again.unwrap_or_else(|errors| panic!("{errors}")), topology);
    let link = topology.link("hop").unwrap();
    let emulation = link.emulation().unwrap();
    (emulation.forward.clone(), emulation.backward.clone())
}

const fn ms(count: u64) -> Duration {
    Duration::from_millis(count)
}

#[test]
fn every_delay_law_can_be_written_and_is_written_back() {
    let laws = [
        ("law = \"fixed\"\ndelay = \"5 ms\"", DelayLaw::fixed(ms(5))),
        (
            "law = \"uniform\"\nmin = \"1 ms\"\nmax = \"5 ms\"",
            DelayLaw::Uniform(Uniform {
                min: ms(1),
                max: ms(5),
            }),
        ),
        (
            "law = \"normal\"\nmean = \"20 ms\"\ndeviation = \"5 ms\"",
            DelayLaw::Normal(Normal {
                mean: ms(20),
                deviation: ms(5),
                ..Normal::TEMPLATE
            }),
        ),
        (
            "law = \"log-normal\"\nmin = \"1 ms\"\nmedian = \"2 ms\"\nsigma = 0.7\nmax = \"90 ms\"",
            DelayLaw::LogNormal(LogNormal {
                min: ms(1),
                median: ms(2),
                sigma: 0.7,
                max: ms(90),
            }),
        ),
        (
            "law = \"exponential\"\nmean_excess = \"3 ms\"",
            DelayLaw::Exponential(Exponential {
                mean_excess: ms(3),
                ..Exponential::TEMPLATE
            }),
        ),
        (
            "law = \"pareto\"\nmin = \"1 ms\"\nscale = \"2 ms\"\nshape = 2.5",
            DelayLaw::Pareto(Pareto {
                min: ms(1),
                scale: ms(2),
                shape: 2.5,
                ..Pareto::TEMPLATE
            }),
        ),
        (
            "law = \"histogram\"\nedges = [\"1 ms\", \"2 ms\", \"9 ms\"]\nweights = [3, 0.5]",
            DelayLaw::Histogram(Histogram {
                edges: vec![ms(1), ms(2), ms(9)],
                weights: vec![3.0, 0.5],
            }),
        ),
    ];
    for (text, law) in laws {
        let (forward, backward) = specs(&format!("[links.hop.delay]\n{text}"));
        assert_eq!((&forward.delay, forward.reorders), (&law, false));
        assert_eq!(forward, backward);
        if !law.is_fixed() {
            let text = format!("[links.hop.delay]\nreorders = true\n{text}");
            assert!(specs(&text).0.reorders);
        }
    }
}

#[test]
fn every_delay_law_of_the_list_is_read_with_its_required_keys_and_written_back() {
    for name in DelayLaw::NAMES {
        let mut law = DelayLaw::named(name).unwrap();
        let mut text = format!("[links.hop.delay]\nlaw = \"{name}\"\n");
        let mut has_list = false;
        for field in law.fields() {
            let value = match field.slot {
                _ if !field.is_required => continue,
                Slot::Value(_, Shape::Time(_)) => "\"3 ms\"".to_owned(),
                Slot::Value(_, Shape::Number(range)) => {
                    format!("{:?}", 1.5_f64.clamp(*range.start(), *range.end()))
                }
                _ => {
                    has_list = true;
                    continue;
                }
            };
            text.extend([field.key, " = ", &value, "\n"]);
        }
        if !has_list {
            assert_eq!(specs(&text).0.delay.name(), *name);
        }
    }
}

#[test]
fn every_loss_law_and_every_other_part_can_be_written() {
    let (forward, backward) = specs(
        "loss = { law = \"gilbert-elliott\", to_bad = 0.01, to_good = 0.2, bad_loss_ratio = 0.9 }
rate = { bits_per_second = 2_000_000, queue_bytes = 3000 }
reordering = { ratio = 0.01, hold = \"7 ms\" }
[links.hop.backward]
loss = { law = \"bursts\", good_mean = \"90 ms\", bad_mean = \"10 ms\", good_loss_ratio = 0.01 }
duplication = { ratio = 0.02 }
rate = { bits_per_second = 1_000_000, overhead_bytes = 46 }",
    );
    let expected = LinkSpec {
        outages: forward.outages,
        loss: LossLaw::GilbertElliott(GilbertElliott {
            to_bad: 0.01,
            to_good: 0.2,
            bad_loss_ratio: 0.9,
            good_loss_ratio: 0.0,
        }),
        rate: Some(RateLimit {
            bits_per_second: 2_000_000,
            queue_bytes: 3_000,
            overhead_bytes: 28,
        }),
        reordering: Some(Reordering {
            ratio: 0.01,
            hold: ms(7),
        }),
        ..LinkSpec::default()
    };
    assert_eq!(forward, expected);
    // A direction has what is said of both, but for the parts it says itself.
    let expected = LinkSpec {
        loss: LossLaw::Bursts(Bursts {
            good_mean: ms(90),
            bad_mean: ms(10),
            bad_loss_ratio: 1.0,
            good_loss_ratio: 0.01,
        }),
        rate: Some(RateLimit {
            bits_per_second: 1_000_000,
            queue_bytes: 150_000,
            overhead_bytes: 46,
        }),
        duplication: Some(Duplication {
            ratio: 0.02,
            lag: ms(0),
        }),
        ..expected
    };
    assert_eq!(backward, expected);
}

#[test]
fn a_direction_takes_back_a_law_with_a_shorthand() {
    let (forward, backward) = specs(
        "loss = { law = \"bernoulli\", ratio = 0.2 }
delay = { law = \"uniform\", min = \"1 ms\", max = \"5 ms\", reorders = true }
[links.hop.forward]
loss_ratio = 0.1
delay = \"3 ms\"",
    );
    assert_eq!(forward.loss, LossLaw::bernoulli(0.1));
    assert_eq!(
        (forward.delay, forward.reorders),
        (DelayLaw::fixed(ms(3)), false)
    );
    assert_eq!(backward.loss, LossLaw::bernoulli(0.2));
    assert!(backward.reorders);
}

#[test]
fn defaults_of_the_file_are_those_of_the_models() {
    let (rate, outages) = (
        specs("rate = { bits_per_second = 1000 }").0.rate.unwrap(),
        specs("").0.outages,
    );
    assert_eq!((rate.queue_bytes, rate.overhead_bytes), (150_000, 28));
    assert_eq!(outages, hil_link::outages::Outages::default());
}

/// Tables of a link, the key of the one error, and what it says.
const FAULTY: &[(&str, &str, &str)] = &[
    ("[links.hop.delay]", "links.hop.delay.law", "\"log-normal\""),
    (
        "delay = { law = \"lognormal\" }",
        "links.hop.delay.law",
        "did you mean `log-normal`?",
    ),
    (
        "delay = { law = \"normal\", mean = \"5 ms\" }",
        "links.hop.delay.deviation",
        "missing",
    ),
    (
        "delay = { law = \"normal\", mean = \"5 ms\", deviation = \"0 ms\" }",
        "links.hop.delay.deviation",
        "outside \"1 ns\" to \"10 s\"",
    ),
    (
        "delay = { law = \"normal\", mean = \"5 ms\", deviation = \"1 ms\", max = \"3 ms\" }",
        "links.hop.delay.max",
        "of all draws",
    ),
    (
        "delay = { law = \"uniform\", min = \"5 ms\", max = \"1 ms\" }",
        "links.hop.delay.max",
        "outside 5ms to 10s",
    ),
    (
        "delay = { law = \"pareto\", scale = \"5 ms\", shape = 1 }",
        "links.hop.delay.shape",
        "outside 1.05 to 100",
    ),
    (
        "delay = { law = \"pareto\", scale = \"5 ms\", shape = 2, sigma = 1 }",
        "links.hop.delay.sigma",
        "is not a known key",
    ),
    (
        "delay = { law = \"fixed\", delay = \"5 ms\", reorders = true }",
        "links.hop.delay.reorders",
        "is not a known key",
    ),
    (
        "delay = { law = \"histogram\", edges = [\"1 ms\", \"2 ms\"], weights = [1, 2] }",
        "links.hop.delay.edges",
        "2 edges do not enclose 2 bins",
    ),
    (
        "delay = { law = \"histogram\", edges = [\"1 ms\", \"1 s\"], weights = [-1] }",
        "links.hop.delay.weights",
        "-1 is outside",
    ),
    (
        "delay = { law = \"histogram\", edges = [\"1 ms\", \"20 s\"], weights = [1] }",
        "links.hop.delay.edges",
        " to \"10 s\"",
    ),
    ("delay = 50", "links.hop.delay", "\"20 ms\""),
    (
        "loss_ratio = 0.1\nloss = { law = \"bernoulli\", ratio = 0.1 }",
        "links.hop.loss_ratio",
        "says the loss twice",
    ),
    (
        "loss = { law = \"gilbert-elliot\", to_bad = 0.1 }",
        "links.hop.loss.law",
        "did you mean `gilbert-elliott`?",
    ),
    (
        "loss = { law = \"gilbert-elliott\", to_bad = 0.1, to_good = 0 }",
        "links.hop.loss.to_good",
        "0 is outside",
    ),
    (
        "loss = { law = \"bursts\", good_mean = \"1 s\", bad_mean = \"2 h\" }",
        "links.hop.loss.bad_mean",
        "outside \"1 us\"",
    ),
    (
        "rate = { queue_bytes = 100 }",
        "links.hop.rate.bits_per_second",
        "missing",
    ),
    (
        "rate = { bits_per_second = 10, queue_bytes = 100 }",
        "links.hop.rate.bits_per_second",
        "10 is outside 1000 to 100000000000",
    ),
    (
        "reordering = { ratio = 0.1 }",
        "links.hop.reordering.hold",
        "missing",
    ),
    (
        "duplication = { ratio = 1.5 }",
        "links.hop.duplication.ratio",
        "1.5 is outside 0 to 1",
    ),
    (
        "[links.hop.forward]\noutages = { per_hour = 1 }",
        "links.hop.forward.outages",
        "is not a known key",
    ),
    (
        "gateway = { timer_slack = \"1 ms\" }",
        "links.hop.gateway",
        "at most \"45 us\"",
    ),
];

#[test]
fn every_fault_of_a_link_names_its_key() {
    for (below, key, says) in FAULTY {
        let errors = parse("faulty.toml", &with_link(below), &[], &known()).expect_err(below);
        let [error] = errors.errors() else {
            panic!("{below}: one fault, several errors:\n{errors}");
        };
        assert_eq!(error.key, *key, "{errors}");
        assert!(error.location.is_some());
        let text = errors.render(false);
        assert!(text.contains(says), "`{says}` is not in\n{text}");
    }
}

#[test]
fn no_real_link_can_be_told_what_to_do() {
    for below in [
        "rate = { bits_per_second = 1000 }",
        "loss = { law = \"bernoulli\", ratio = 0.1 }",
        "duplication = { ratio = 0.1 }",
        "reordering = { ratio = 0.1, hold = \"1 ms\" }",
    ] {
        let text = with_link(below).replace("\"emulated\"", "\"udp\"");
        let errors = parse("real.toml", &text, &[], &known()).unwrap_err();
        assert!(
            errors.to_string().contains("no real link can be told"),
            "{errors}"
        );
    }
}
