//! What can be wrong with the bytes of an artifact.

/// A damaged, foreign or newer file; says which section and which byte of the file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FormatError {
    /// The first bytes are not those of a pvmap file.
    #[error("not a pvmap file (found {found})")]
    NotOurs {
        /// What the first bytes look like.
        found: String,
    },
    /// A pvmap file, but of the other kind.
    #[error("this is {found}, {wanted} is needed")]
    WrongKind {
        /// What it is.
        found: &'static str,
        /// What was asked for.
        wanted: &'static str,
    },
    /// Made by a version this reader does not know.
    #[error(
        "made by format version {major}.{minor}, this pvmap reads up to {ours}; use a newer pvmap, \
         or make the file again with this one"
    )]
    Version {
        /// Its major version.
        major: u16,
        /// Its minor version.
        minor: u16,
        /// The newest version that can be read.
        ours: &'static str,
    },
    /// It needs a feature this reader does not know.
    #[error(
        "needs a feature this pvmap does not know (required flags {flags:#x}); use a newer pvmap"
    )]
    Required {
        /// The flags of the header.
        flags: u64,
    },
    /// The file is shorter or longer than its header says.
    #[error("{found} bytes long, its header says {expected}: cut short or added to; make it again")]
    Length {
        /// Length by the header.
        expected: u64,
        /// Length found.
        found: u64,
    },
    /// A checksum does not match.
    #[error("damaged: checksum of {section} differs at byte {offset_bytes}; make the file again")]
    Checksum {
        /// The section.
        section: String,
        /// Start of the block, from the start of the file.
        offset_bytes: u64,
    },
    /// The bytes break a rule of FORMAT.md although their checksums hold.
    #[error("damaged: {section} at byte {offset_bytes}: {what}; make the file again")]
    Broken {
        /// The section.
        section: String,
        /// The place, from the start of the file.
        offset_bytes: u64,
        /// What is wrong: expected and found.
        what: String,
    },
}
