//! `hil-runtime key`: makes a key file, or says whether one can be used. It never prints a key.

use std::path::PathBuf;

use clap::Subcommand;

use super::key_file::{KeyFileError, PreSharedKey};

/// What to do with a key file.
#[derive(Debug, Subcommand)]
pub enum KeyCommand {
    /// Make a key file for its owner alone.
    #[command(
        after_help = "Example:\n  sudo hil-runtime key new /etc/hil-runtime/hop.key\n  sudo scp -p /etc/hil-runtime/hop.key root@robot-pc:/etc/hil-runtime/\n\nA file that is there already is not overwritten. The topology names it in\n[security] key."
    )]
    New {
        /// The file to make.
        file: PathBuf,
    },
    /// Say whether a key file can be used, and its fingerprint, which is equal on all hosts.
    #[command(
        after_help = "Example:\n  sudo hil-runtime key check /etc/hil-runtime/hop.key\n\nExit code 2 when the file cannot be used, with what to do."
    )]
    Check {
        /// The file to look at.
        file: PathBuf,
    },
}

impl KeyCommand {
    /// Does it; what to print.
    ///
    /// # Errors
    /// Why the file cannot be made or used.
    pub fn work(&self) -> Result<String, KeyFileError> {
        Ok(match self {
            Self::New { file } => {
                let key = PreSharedKey::create(file)?;
                // In a topology a path counts from the topology's folder.
                let named = std::path::absolute(file).unwrap_or_else(|_| file.clone());
                format!(
                    "made {}\nfingerprint {}\n\nCopy it to the other hosts with its mode (scp -p) and name it in the topology:\n\n\
                     [security]\nkey = \"{}\"\n",
                    file.display(),
                    key.fingerprint(),
                    named.display()
                )
            }
            Self::Check { file } => {
                let key = PreSharedKey::read(file)?;
                format!(
                    "{}: can be used\nfingerprint {}\n",
                    file.display(),
                    key.fingerprint()
                )
            }
        })
    }
}
