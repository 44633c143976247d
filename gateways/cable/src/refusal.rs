//! Why a program cannot have a namespace of its own here, and what cures it.

use core::fmt;
use std::{fs, io};

use nix::errno::Errno;

/// What was tried.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// User, network and mount namespaces.
    Namespaces,
    /// The identity of the user in the user namespace.
    Identity,
    /// The packet socket of the cable's end.
    PacketSocket,
    /// The pair of interfaces.
    Interfaces,
    /// Address and routes.
    Addresses,
    /// Finishing frames in software.
    Offload,
    /// Mounts of the program's own.
    Mounts,
}

impl Step {
    const fn words(self) -> &'static str {
        match self {
            Self::Namespaces => "make namespaces for the program",
            Self::Identity => "keep the user's identity in them",
            Self::PacketSocket => "open a packet socket in them",
            Self::Interfaces => "make a pair of veth interfaces in them",
            Self::Addresses => "give the program its address and routes",
            Self::Offload => "switch off the offloads of the program's interface",
            Self::Mounts => "mount the program's own folders",
        }
    }
}

/// What was refused, why, and what cures it.
#[derive(Debug)]
pub struct Refusal {
    step: Step,
    source: io::Error,
    kernel: Kernel,
}

impl Refusal {
    pub(crate) fn new(step: Step, source: io::Error) -> Self {
        let kernel = Kernel::read();
        Self {
            step,
            source,
            kernel,
        }
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let cure = cure(self.step, &self.source, &self.kernel);
        write!(f, "cannot {}: {}; {cure}", self.step.words(), self.source)
    }
}

impl std::error::Error for Refusal {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        Some(&self.source)
    }
}

/// The settings of the kernel on which it depends; `None` for one that this kernel does not have.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Kernel {
    /// `kernel.apparmor_restrict_unprivileged_userns`.
    apparmor_restricts: Option<u64>,
    /// `kernel.unprivileged_userns_clone`.
    userns_clone: Option<u64>,
    /// `user.max_user_namespaces`.
    user_namespaces_max: Option<u64>,
    /// `user.max_net_namespaces`.
    net_namespaces_max: Option<u64>,
}

impl Kernel {
    fn read() -> Self {
        let number = |path: &str| {
            let text = fs::read_to_string(format!("/proc/sys/{path}")).ok()?;
            text.trim().parse().ok()
        };
        Self {
            apparmor_restricts: number("kernel/apparmor_restrict_unprivileged_userns"),
            userns_clone: number("kernel/unprivileged_userns_clone"),
            user_namespaces_max: number("user/max_user_namespaces"),
            net_namespaces_max: number("user/max_net_namespaces"),
        }
    }
}

fn cure(step: Step, error: &io::Error, kernel: &Kernel) -> String {
    let limit = |name: &str, value: Option<u64>| {
        let value = value.map_or_else(|| "unknown".to_owned(), |value| value.to_string());
        format!("{name} is {value}")
    };
    match (step, error.raw_os_error().map(Errno::from_raw)) {
        (_, Some(Errno::EPERM | Errno::EACCES)) if kernel.userns_clone == Some(0) => {
            "kernel.unprivileged_userns_clone is 0: sysctl kernel.unprivileged_userns_clone=1, or run as root"
                .to_owned()
        }
        (_, Some(Errno::EPERM | Errno::EACCES)) if kernel.apparmor_restricts == Some(1) => {
            "AppArmor takes the rights of user namespaces away: give hil-runtime a profile with `userns,`, or \
             sysctl kernel.apparmor_restrict_unprivileged_userns=0, or run as root"
                .to_owned()
        }
        (Step::Namespaces, Some(Errno::ENOSPC)) => format!(
            "{}, {}: raise the one that is used up with sysctl",
            limit("user.max_user_namespaces", kernel.user_namespaces_max),
            limit("user.max_net_namespaces", kernel.net_namespaces_max),
        ),
        (Step::Namespaces, Some(Errno::EINVAL | Errno::ENOSYS)) => {
            "this kernel has no user or network namespaces (CONFIG_USER_NS, CONFIG_NET_NS)".to_owned()
        }
        (Step::Namespaces, Some(Errno::EPERM)) => {
            "a container's seccomp profile or a chroot forbids it: --security-opt seccomp=unconfined, or \
             --cap-add SYS_ADMIN, or outside of the chroot"
                .to_owned()
        }
        (Step::PacketSocket, Some(Errno::EAFNOSUPPORT)) => {
            "packet sockets are missing: modprobe af_packet".to_owned()
        }
        (Step::PacketSocket, Some(Errno::ENOMEM)) => {
            "a ring of 8 MiB has no memory: end what fills it".to_owned()
        }
        (Step::Interfaces, Some(Errno::EOPNOTSUPP)) => {
            "veth interfaces are missing: modprobe veth".to_owned()
        }
        (Step::Addresses, Some(Errno::EOPNOTSUPP | Errno::EAFNOSUPPORT | Errno::EACCES)) => {
            "this kernel has IPv6 switched off: use an IPv4 address inside".to_owned()
        }
        (Step::Mounts, Some(Errno::EPERM)) => {
            "a container that masks parts of /proc or /sys forbids it: --security-opt systempaths=unconfined"
                .to_owned()
        }
        _ => "hil-runtime doctor says what this host lacks".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_refusal_of_the_kernel_is_told_with_its_cure() {
        let plain = Kernel {
            user_namespaces_max: Some(0),
            net_namespaces_max: Some(9),
            ..Kernel::default()
        };
        let debian = Kernel {
            userns_clone: Some(0),
            ..plain
        };
        let ubuntu = Kernel {
            apparmor_restricts: Some(1),
            userns_clone: Some(1),
            ..plain
        };
        for (step, errno, kernel, expected) in [
            (
                Step::Namespaces,
                Errno::EPERM,
                debian,
                "unprivileged_userns_clone=1",
            ),
            (Step::Namespaces, Errno::EPERM, ubuntu, "AppArmor"),
            (Step::Interfaces, Errno::EPERM, ubuntu, "AppArmor"),
            (Step::Namespaces, Errno::EPERM, plain, "seccomp"),
            (
                Step::Namespaces,
                Errno::ENOSPC,
                plain,
                "max_user_namespaces is 0",
            ),
            (Step::Namespaces, Errno::EINVAL, plain, "CONFIG_USER_NS"),
            (
                Step::PacketSocket,
                Errno::EAFNOSUPPORT,
                plain,
                "modprobe af_packet",
            ),
            (Step::Interfaces, Errno::EOPNOTSUPP, plain, "modprobe veth"),
            (Step::Addresses, Errno::EACCES, plain, "IPv4"),
            (Step::Mounts, Errno::EPERM, plain, "systempaths"),
        ] {
            let source = io::Error::from(errno);
            let refusal = Refusal {
                step,
                source,
                kernel,
            };
            let text = refusal.to_string();
            assert!(
                text.starts_with("cannot ") && text.contains(expected),
                "{text}"
            );
        }
    }
}
