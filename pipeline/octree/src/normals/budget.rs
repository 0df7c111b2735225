//! What estimation may hold: how large tiles, blocks and buffers are.

use pvmap_store::StoreError;

use super::{KnownPoint, Wanted};

/// Bytes a block: its box and those above (24 · 8/7), its first point, two flags.
pub(super) const BLOCK_BYTES: u64 = 38;

/// Points a block, where memory allows: 64 x 64 on a surface, so that halos are thin, reads long.
const BLOCK_POINTS: u64 = 4096;
/// The fewest points a block: as many as a neighbourhood.
const MIN_BLOCK_POINTS: u64 = 16;
/// Blocks a tile: then its halo is about a fifth of it on a surface.
const TILE_BLOCKS: u64 = 256;
/// Blocks the smallest tile still has.
const MIN_TILE_BLOCKS: u64 = 4;

/// Points in one read and one call of the sink, where memory allows.
const CHUNK_POINTS: u64 = 1 << 16;
const MIN_CHUNK_POINTS: u64 = 256;

/// The shares of `--memory`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Budget {
    /// For the points of a tile with its halo: 3/4.
    pub(super) tile_bytes: u64,
    /// For the boxes over the whole cloud: 1/8.
    pub(super) blocks_bytes: u64,
    /// Points in one read: at most 1/16 in a buffer, as much again for what the sink gets.
    pub(super) chunk_points: usize,
    point_bytes: u64,
    memory_bytes: u64,
}

impl Budget {
    /// Shares `memory_bytes` out.
    pub(super) fn new(memory_bytes: u64, wanted: Wanted) -> Budget {
        let chunk = memory_bytes / 16 / size_of::<KnownPoint>() as u64;
        // Position 12, count 1, result 8, its share of a bucket and the boxes above at most 4;
        // where neighbours vote, their normals 6, where these start 4, a flag 1.
        let point_bytes = match wanted {
            Wanted::All => 25,
            Wanted::Missing => 36,
        };
        Budget {
            // Positions are counted in u32.
            tile_bytes: (memory_bytes / 4 * 3).min(u64::from(u32::MAX) * point_bytes),
            blocks_bytes: memory_bytes / 8,
            chunk_points: chunk.clamp(MIN_CHUNK_POINTS, CHUNK_POINTS) as usize,
            point_bytes,
            memory_bytes,
        }
    }

    /// Gives what the points of a tile need.
    pub(super) fn points_bytes(&self, n_points: u64) -> u64 {
        n_points * self.point_bytes
    }

    /// Gives how many points a block should have at first.
    pub(super) fn block_points(&self) -> u64 {
        let tile_points = self.tile_bytes / self.point_bytes;
        (tile_points / TILE_BLOCKS).clamp(MIN_BLOCK_POINTS, BLOCK_POINTS)
    }

    /// Says that blocks of `block_points` are too many for the budget; gives a larger size.
    ///
    /// # Errors
    /// [`StoreError::Budget`] when a few larger blocks would not fit a tile.
    pub(super) fn larger_blocks(&self, block_points: u64) -> Result<u64, StoreError> {
        let larger = 2 * block_points;
        if self.points_bytes(larger * MIN_TILE_BLOCKS) <= self.tile_bytes {
            Ok(larger)
        } else {
            Err(StoreError::Budget {
                what: "estimating normals",
                need_bytes: 2 * self.memory_bytes,
                have_bytes: self.memory_bytes,
            })
        }
    }
}
