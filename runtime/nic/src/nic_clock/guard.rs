//! Puts a card back as it was when the program that set it up cannot: after `SIGKILL`, a second
//! Ctrl-C, a panic that aborts. A small process of its own holds the former setting and one end of a
//! pipe. The kernel closes the other end with the program, however that ends.
//!
//! The guard is in a process group of its own and deaf to the signals that end programs, so that
//! neither Ctrl-C at the terminal nor a service manager's SIGTERM ends it first. Whoever kills both
//! with `SIGKILL` leaves the card as it is.

use std::io::{self, BufRead, BufReader, Read, Write};
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use clap::Args;
use hil_net::nic_arming::{ArmedNic, InterfaceNic, NicControl, describe_setting};
use hil_net::timestamping::HardwareStamping;
use signal_hook::consts::{SIGHUP, SIGINT, SIGQUIT, SIGTERM};
use signal_hook::flag;

use hil_platform::console::Console;
use hil_platform::{open_files, own_process};

/// What the guard says once no signal ends it any more.
const READY: &str = "ready";
/// What it is told when the card was put back.
const RELEASED: u8 = b'r';

/// A card that stamps, and that comes back as it was found whatever becomes of this program.
#[derive(Debug)]
pub struct GuardedNic<C: NicControl = InterfaceNic> {
    // Before the guard: it is put back first, and the guard let go afterwards.
    armed: ArmedNic<C>,
    guard: Option<Guard>,
}

impl GuardedNic {
    /// Arms the card behind `interface`. A card that this program guards already keeps that guard:
    /// the first one knows how it was found.
    ///
    /// # Errors
    /// In words, when the card cannot be armed or guarded; it is left as it was.
    pub fn arm(interface: &str, is_guarded: bool) -> Result<Self, String> {
        let card = InterfaceNic {
            interface: interface.to_owned(),
        };
        Self::arm_with(card, |former| {
            if is_guarded {
                return Ok(None);
            }
            Guard::start(guard_command(interface, former)).map(Some)
        })
    }
}

impl<C: NicControl> GuardedNic<C> {
    fn arm_with(
        card: C,
        start: impl FnOnce(HardwareStamping) -> io::Result<Option<Guard>>,
    ) -> Result<Self, String> {
        let guard = match card.query() {
            Ok(former) => start(former).map_err(|error| {
                format!("no guard that would put the card back could be started: {error}")
            })?,
            // Arming says what that means, and leaves the card alone.
            Err(_unreadable) => None,
        };
        let armed = ArmedNic::arm(card).map_err(|error| error.to_string())?;
        Ok(Self { armed, guard })
    }

    /// The card.
    pub const fn armed(&self) -> &ArmedNic<C> {
        &self.armed
    }

    /// Puts the card back as it was, and says what it was and whether that came about.
    pub fn restore_in_words(&mut self) -> String {
        let told = self.armed.restore_in_words();
        self.guard = None;
        told
    }
}

/// The process that waits for this one's end. Dropping it lets it go.
#[derive(Debug)]
struct Guard {
    process: Child,
}

impl Guard {
    /// Starts the guard and waits until no signal ends it any more.
    fn start(mut command: Command) -> io::Result<Self> {
        open_files::withhold()?;
        let mut process = command
            .process_group(0)
            .current_dir("/")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()?;
        let output = process.stdout.take().expect("piped just above");
        // From here on its drop waits for the process.
        let guard = Self { process };
        let mut word = String::new();
        BufReader::new(output).read_line(&mut word)?;
        if word.trim_end() == READY {
            Ok(guard)
        } else {
            Err(io::Error::other(format!("it said {word:?}")))
        }
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        if let Some(mut input) = self.process.stdin.take() {
            // One that was killed cannot be told, and has nothing left to do.
            let _gone = input.write_all(&[RELEASED]).is_err();
        }
        let _reaped = self.process.wait().is_ok();
    }
}

fn guard_command(interface: &str, former: HardwareStamping) -> Command {
    let mut command = own_process::again();
    command.arg("card-guard");
    for (name, value) in [
        ("interface", interface.to_owned()),
        ("flags", former.flags.to_string()),
        ("transmit-type", former.transmit_type.to_string()),
        ("receive-filter", former.receive_filter.to_string()),
    ] {
        command.arg(format!("--{name}={value}"));
    }
    command
}

/// Why a guard did not do its work.
#[derive(Debug, thiserror::Error)]
pub enum GuardError {
    /// It cannot take over signals.
    #[error("the guard of card {interface} cannot take over signals: {source}")]
    Signals {
        /// The card.
        interface: String,
        /// What the kernel answered.
        source: io::Error,
    },
    /// It cannot read the pipe to its program.
    #[error("the guard of card {interface} lost its pipe: {source}")]
    Pipe {
        /// The card.
        interface: String,
        /// What the kernel answered.
        source: io::Error,
    },
    /// The card keeps the setting of the program that is gone.
    #[error(
        "card {interface}: the program that set it up is gone, and its setting ({former}) could NOT \
         be put back: {reason}"
    )]
    NotRestored {
        /// The card.
        interface: String,
        /// The setting to put back.
        former: String,
        /// Why it could not be.
        reason: String,
    },
}

/// How a network card was found, in the kernel's numbers (`struct hwtstamp_config`).
#[derive(Debug, Args)]
pub struct NicGuardArgs {
    /// Its interface.
    #[arg(long)]
    pub interface: String,
    /// `flags`.
    #[arg(long, allow_negative_numbers = true)]
    pub flags: i32,
    /// `tx_type`.
    #[arg(long, allow_negative_numbers = true)]
    pub transmit_type: i32,
    /// `rx_filter`.
    #[arg(long, allow_negative_numbers = true)]
    pub receive_filter: i32,
}

/// What the process of a guard does until its program is gone or lets it go.
///
/// # Errors
/// See [`GuardError`].
pub fn run(args: &NicGuardArgs) -> Result<(), GuardError> {
    let interface = || args.interface.clone();
    for signal in [SIGINT, SIGTERM, SIGHUP, SIGQUIT] {
        // Nobody looks at the flag: having it is what keeps the signal from ending the guard.
        let deaf = flag::register(signal, Arc::new(AtomicBool::new(false)));
        deaf.map_err(|source| GuardError::Signals {
            interface: interface(),
            source,
        })?;
    }
    let pipe = |source| GuardError::Pipe {
        interface: interface(),
        source,
    };
    let mut output = io::stdout();
    writeln!(output, "{READY}").map_err(pipe)?;
    output.flush().map_err(pipe)?;
    let card = InterfaceNic {
        interface: interface(),
    };
    let former = HardwareStamping {
        flags: args.flags,
        transmit_type: args.transmit_type,
        receive_filter: args.receive_filter,
    };
    match stand_guard(&mut io::stdin().lock(), &card, former).map_err(pipe)? {
        GuardEnd::Released => Ok(()),
        GuardEnd::Restored => {
            let (name, former) = (&args.interface, describe_setting(former));
            Console::new(true).warn(&format!(
                "card {name}: the program that set it up ended without putting it back; it is \
                 {former} again"
            ));
            Ok(())
        }
        GuardEnd::NotRestored(reason) => Err(GuardError::NotRestored {
            interface: interface(),
            former: describe_setting(former),
            reason,
        }),
    }
}

#[derive(Debug, PartialEq, Eq)]
enum GuardEnd {
    /// The program put the card back itself.
    Released,
    /// The program was gone, and the card is as it was.
    Restored,
    /// The same, but the card would not.
    NotRestored(String),
}

/// Waits for the word on `input`; if it ends without one, puts `card` back to `former`.
fn stand_guard(
    input: &mut impl Read,
    card: &impl NicControl,
    former: HardwareStamping,
) -> io::Result<GuardEnd> {
    let mut word = Vec::new();
    // Signals only interrupt this, and it goes on.
    input.take(1).read_to_end(&mut word)?;
    if word == [RELEASED] {
        return Ok(GuardEnd::Released);
    }
    let settled = card.set(former);
    Ok(match settled.and_then(|_settled| card.query()) {
        Ok(now) if now == former => GuardEnd::Restored,
        Ok(now) => GuardEnd::NotRestored(format!("the card settled for {}", describe_setting(now))),
        Err(error) => GuardEnd::NotRestored(error.to_string()),
    })
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::sync::Mutex;

    use super::*;

    const FOUND: HardwareStamping = HardwareStamping {
        flags: 0,
        transmit_type: 0,
        receive_filter: 12,
    };

    /// A card that takes every setting, or keeps the one it has.
    #[derive(Debug, Clone)]
    struct FakeNic {
        setting: Arc<Mutex<HardwareStamping>>,
        is_stubborn: bool,
    }

    impl FakeNic {
        fn found() -> Self {
            Self {
                setting: Arc::new(Mutex::new(FOUND)),
                is_stubborn: false,
            }
        }

        fn setting(&self) -> HardwareStamping {
            *self.setting.lock().unwrap()
        }
    }

    impl NicControl for FakeNic {
        fn query(&self) -> io::Result<HardwareStamping> {
            Ok(self.setting())
        }

        fn set(&self, wanted: HardwareStamping) -> io::Result<HardwareStamping> {
            if !self.is_stubborn {
                *self.setting.lock().unwrap() = wanted;
            }
            self.query()
        }
    }

    fn shell(script: &str) -> Command {
        let mut command = Command::new("sh");
        command.args(["-c", script]);
        command
    }

    #[test]
    fn the_end_of_the_pipe_puts_the_nic_back_and_a_word_does_not() {
        let card = FakeNic::found();
        let armed = card.set(FOUND.with_transmit()).unwrap();
        let end = stand_guard(&mut [RELEASED].as_slice(), &card, FOUND).unwrap();
        assert_eq!((end, card.setting()), (GuardEnd::Released, armed));
        let end = stand_guard(&mut io::empty(), &card, FOUND).unwrap();
        assert_eq!((end, card.setting()), (GuardEnd::Restored, FOUND));
    }

    #[test]
    fn a_nic_that_does_not_go_back_is_said_to() {
        let mut card = FakeNic::found();
        let _armed = card.set(FOUND.with_transmit()).unwrap();
        card.is_stubborn = true;
        let end = stand_guard(&mut io::empty(), &card, FOUND).unwrap();
        let words = "the card settled for transmit on, receive filter PTPv2 event";
        assert_eq!(end, GuardEnd::NotRestored(words.to_owned()));
    }

    #[test]
    fn the_guard_stands_before_the_nic_is_armed_and_goes_after_it_was_put_back() {
        let path = std::env::temp_dir().join(format!("hil-guard-{}", std::process::id()));
        let card = FakeNic::found();
        let heard = format!("echo {READY}; head -c 1 >{}", path.display());
        let mut guarded = GuardedNic::arm_with(card.clone(), |former| {
            assert_eq!((former, card.setting()), (FOUND, FOUND));
            Guard::start(shell(&heard)).map(Some)
        })
        .unwrap();
        assert!(guarded.armed().granted().is_transmit_on());
        assert!(card.setting().is_transmit_on());
        let told = guarded.restore_in_words();
        assert!(told.ends_with("put back so"), "{told}");
        assert_eq!(card.setting(), FOUND);
        // It has gone already: dropping waits for it.
        assert_eq!(fs::read(&path).unwrap(), [RELEASED]);
        fs::remove_file(path).unwrap();
    }

    #[test]
    fn a_nic_that_cannot_be_guarded_is_not_armed() {
        for script in ["exit 1", "echo something else"] {
            let card = FakeNic::found();
            let error = GuardedNic::arm_with(card.clone(), |_former| {
                Guard::start(shell(script)).map(Some)
            })
            .unwrap_err();
            assert!(error.contains("no guard"), "{error}");
            assert_eq!(card.setting(), FOUND);
        }
    }

    #[test]
    fn the_command_names_the_setting_that_was_found() {
        let odd = HardwareStamping {
            flags: 1,
            transmit_type: 2,
            receive_filter: -1,
        };
        let command = guard_command("eth0", odd);
        let arguments: Vec<_> = command
            .get_args()
            .map(|one| one.to_str().unwrap())
            .collect();
        let expected = [
            "card-guard",
            "--interface=eth0",
            "--flags=1",
            "--transmit-type=2",
            "--receive-filter=-1",
        ];
        assert_eq!(arguments, expected);
    }
}
