/* imud.h - reads the shared-memory rings of imud, the inertial sensor daemon. One header, C99 or C++, libc only.
 *
 *   imud_ring ring;
 *   int error = imud_open(&ring, "imu0");             // or a path: "/run/imud/shm/imud.imu0"
 *   if (error) { fprintf(stderr, "%s\n", imud_strerror(error)); return 1; }
 *   for (;;) {
 *       imud_slot sample;
 *       uint64_t missed;
 *       while (imud_next(&ring, &sample, &missed) == 1)   // `missed`: samples lost right before this one
 *           use(sample.accel_m_s2, sample.present & IMUD_HAS_ACCEL);
 *       if (imud_health(&ring, imud_now_ns()) != IMUD_HEALTH_LIVE)
 *           imud_reopen(&ring);                           // a new ring: restarted, or the old one removed or cut
 *       if (imud_wait(wake_fd, 100) == IMUD_E_ENDED)      // wake_fd: `notify` of imud's UNIX socket gives it
 *           wake_fd = ask_for_another();                  // the daemon has ended; -1 only waits
 *   }
 *
 * Units: m/s2, rad/s, tesla, rad, degrees Celsius, pascal; times are ns of CLOCK_MONOTONIC, `utc_ns` of CLOCK_REALTIME.
 * A field without its bit in `present` has no value: absent is not zero.
 *
 * The writer has no memory fence, so a slot is trusted only if its sequence number before the copy, its CRC-32, and its
 * sequence number after the copy agree. Nothing here waits busily: a slot that is not whole yet is given by a later call.
 * Synchronization: a ring belongs to one thread; several threads or processes may each open their own.
 *
 * A ring is looked up by name in the directory of the environment variable IMUD_SHM; where that is not set, in
 * /run/imud/shm, then in $XDG_RUNTIME_DIR/imud/shm. Its file must belong to root or to the owner of that directory. In a
 * directory where every user may make files, such as /dev/shm, name the daemon's user: imud_open_owned.
 *
 * Reading a page that was cut off the file raises SIGBUS. Only root and the daemon's user can cut it; the daemon
 * restores the size with its next sample, at the latest a tenth of a second later; imud_health looks at the size first.
 *
 * With -std=c99 (no GNU extensions) include it before other headers, or compile with -D_POSIX_C_SOURCE=200809L.
 * SPDX-License-Identifier: Apache-2.0
 */
#ifndef IMUD_H
#define IMUD_H

#if defined(__STRICT_ANSI__) && !defined(_POSIX_C_SOURCE) && !defined(_GNU_SOURCE)
#define _POSIX_C_SOURCE 200809L
#endif

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

#ifndef CLOCK_MONOTONIC
#error "imud.h: include it before other headers, or compile with -D_POSIX_C_SOURCE=200809L"
#endif
#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "imud.h: the rings are little-endian and this machine is not"
#endif

/* ---- layout -------------------------------------------------------------------------------------------------- */

#define IMUD_MAGIC "imudshm" /* with the final zero, 8 bytes */
#define IMUD_LAYOUT_VERSION 2u
#define IMUD_SLOT_LAYOUT_VERSION 2u
#define IMUD_HEADER_BYTES 4096u
#define IMUD_SLOT_BYTES 320u
#define IMUD_NO_COUNT 255 /* absent `position_quality` or `position_satellites` */
#define IMUD_LEDGER_ROOM 59
#define IMUD_SEQ_INVALID UINT64_MAX       /* stands in `seq` and `ledger_update` while their block is written */
#define IMUD_HEARTBEAT_LIMIT_NS 1000000000 /* the heartbeat comes ten times a second */

enum { IMUD_STATE_LIVE = 1, IMUD_STATE_CLOSED = 2 };

/* Where `t_ns` comes from, worst first. */
enum { IMUD_SYNC_ARRIVAL = 0, IMUD_SYNC_REGRESSION = 1, IMUD_SYNC_EDGE = 2, IMUD_SYNC_UTC = 3 };

/* Bits of `present`. */
enum {
    IMUD_HAS_T_DEV = 1 << 0,
    IMUD_HAS_ACCEL = 1 << 1,
    IMUD_HAS_GYRO = 1 << 2,
    IMUD_HAS_MAG = 1 << 3,
    IMUD_HAS_QUAT = 1 << 4,
    IMUD_HAS_EULER = 1 << 5,
    IMUD_HAS_TEMPERATURE = 1 << 6,
    IMUD_HAS_PRESSURE = 1 << 7,
    IMUD_HAS_INCLI = 1 << 8,
    IMUD_HAS_STATUS = 1 << 9,
    IMUD_HAS_PPS_AGE = 1 << 10,
    IMUD_HAS_EDGE = 1 << 11,
    IMUD_HAS_VELOCITY = 1 << 12,
    IMUD_HAS_POSITION = 1 << 13,
    IMUD_HAS_HEAVE = 1 << 14,
    IMUD_HAS_GNSS_UTC = 1 << 15
};

/* Places in `ledger`. */
enum {
    IMUD_LEDGER_BYTES_IN,
    IMUD_LEDGER_BYTES_IN_GOOD_FRAMES,
    IMUD_LEDGER_BYTES_IN_BAD_FRAMES,
    IMUD_LEDGER_BYTES_SKIPPED,
    IMUD_LEDGER_BYTES_PENDING,
    IMUD_LEDGER_FRAMES_GOOD,
    IMUD_LEDGER_FRAMES_IN_SAMPLES,
    IMUD_LEDGER_FRAMES_IN_REPLIES,
    IMUD_LEDGER_FRAMES_IGNORED,
    IMUD_LEDGER_FRAMES_PENDING,
    IMUD_LEDGER_FRAMES_BAD_CRC,
    IMUD_LEDGER_FRAMES_BAD_LENGTH,
    IMUD_LEDGER_FRAMES_BAD_CONTENT,
    IMUD_LEDGER_UNKNOWN_TAGS,
    IMUD_LEDGER_SAMPLES,
    IMUD_LEDGER_LOST_GAP_DEVICE,
    IMUD_LEDGER_LOST_CRC,
    IMUD_LEDGER_LOST_OVERRUN,
    IMUD_LEDGER_LOST_QUEUE,
    IMUD_LEDGER_REPLIES_LATE,
    IMUD_LEDGER_REPLIES_UNSOLICITED,
    IMUD_LEDGER_FRAMES_NOT_FINITE,
    IMUD_LEDGER_LOST_UNKNOWN,
    IMUD_LEDGER_FRAMES_LOST
};

/* One sample: a slot of the ring, and a record of the socket's binary encoding. */
typedef struct imud_slot {
    uint64_t seq;     /* counts from 1 per device */
    int64_t t_ns;     /* instant of measurement, CLOCK_MONOTONIC, strictly increasing */
    int64_t t_rx_ns;  /* when the last byte was read, CLOCK_MONOTONIC */
    int64_t utc_ns;   /* t_ns on CLOCK_REALTIME */
    int64_t t_dev_ns; /* device time, unwrapped */
    uint64_t edge_seq; /* number of the SOUT edge, or SIN trigger, that belongs to the sample */
    uint32_t t_err_ns; /* one-sigma error of t_ns */
    uint32_t present;  /* IMUD_HAS_... */
    uint32_t status;   /* status bits as sent; bits 31 and 30 are imud's own: the ALARM line was active, the attitude
                          filter of the host has not settled */
    uint16_t device_id;
    uint8_t sync; /* IMUD_SYNC_... */
    uint8_t reserved0;
    double accel_m_s2[3];
    double gyro_rad_s[3];
    double mag_t[3];
    double quat_wxyz[4]; /* body to navigation frame */
    double euler_rad[3]; /* roll, pitch, yaw in the device's own convention */
    double temperature_c;
    double pressure_pa;
    double incli_rad[2];
    uint32_t pps_age_ms;
    uint8_t position_quality;    /* as sent, 0 is invalid; IMUD_NO_COUNT if it is absent */
    uint8_t position_satellites; /* IMUD_NO_COUNT if it is absent */
    uint8_t reserved1[2];
    int64_t gnss_utc_ns; /* UTC of the measurement from the GNSS receiver of the device, since 1970 */
    double heave_m;      /* vertical displacement from the mean height, positive up */
    uint8_t reserved2[4];
    uint32_t crc32; /* of the bytes before it, and of the bytes after it with IMUD_HAS_VELOCITY or IMUD_HAS_POSITION */
    double velocity_enu_m_s[3]; /* east, north, up */
    double latitude_rad;        /* position, WGS 84: positive to the north */
    double longitude_rad;       /* positive to the east */
    double height_m;            /* above mean sea level; NaN if it is absent */
    uint8_t reserved3[16];
} imud_slot;

/* First page of a ring. */
typedef struct imud_header {
    char magic[8];
    uint32_t layout_version;
    uint32_t slot_layout_version;
    uint32_t header_bytes;
    uint32_t slot_bytes;
    uint32_t slot_count; /* a power of two */
    uint32_t ledger_count;
    uint64_t epoch; /* another number after every start of the daemon */
    uint32_t pid;
    uint32_t state; /* IMUD_STATE_... */
    uint32_t device_id;
    uint8_t reserved0[12];
    char device[64];
    uint8_t reserved1[64];
    uint64_t newest_seq; /* 0 before the first sample */
    uint64_t first_seq;  /* older samples were never in this ring */
    int64_t heartbeat_ns;
    uint8_t reserved2[40];
    uint64_t ledger_update;
    char driver[32];
    uint64_t ledger[IMUD_LEDGER_ROOM];
    uint32_t ledger_crc32; /* of ledger_update, driver and ledger */
    uint8_t reserved3[3324];
} imud_header;

/* Copy of the ledger block. */
typedef struct imud_ledger {
    uint64_t update; /* +1 for every change */
    char driver[32];
    uint64_t values[IMUD_LEDGER_ROOM]; /* IMUD_LEDGER_..., header->ledger_count of them in use */
    uint32_t crc32;
    uint32_t padding;
} imud_ledger;

/* Compilation stops here if the compiler lays the records out differently. */
typedef char imud_check_slot[sizeof(imud_slot) == IMUD_SLOT_BYTES ? 1 : -1];
typedef char imud_check_header[sizeof(imud_header) == IMUD_HEADER_BYTES ? 1 : -1];
typedef char imud_check_ledger[offsetof(imud_ledger, crc32) == offsetof(imud_header, ledger_crc32) - 256 ? 1 : -1];

/* ---- results ------------------------------------------------------------------------------------------------- */

enum {
    IMUD_E_MISSING = -1, /* no such ring: the daemon does not run, or has no such device */
    IMUD_E_DENIED = -2,  /* this user may not read it: look at the group of the file */
    IMUD_E_FORMAT = -3,  /* the file is no ring */
    IMUD_E_VERSION = -4, /* a ring of another layout version */
    IMUD_E_SYSTEM = -5,  /* see errno */
    IMUD_E_NAME = -6,    /* name too long or empty */
    IMUD_E_ENDED = -7,   /* the daemon ended the descriptor to wait on: ask its socket for another */
    IMUD_E_OWNER = -8    /* the file belongs to a user who may have planted it: see imud_open_owned */
};

typedef enum imud_health_state {
    IMUD_HEALTH_LIVE = 0,
    IMUD_HEALTH_CLOSED = 1, /* the daemon ended the ring, or someone cut its file */
    IMUD_HEALTH_STALE = 2   /* no heartbeat for IMUD_HEARTBEAT_LIMIT_NS: the daemon died or hangs */
} imud_health_state;

/* An open ring. Read `path`, `epoch` and `missed_total` at will; leave the rest alone. */
typedef struct imud_ring {
    const unsigned char *base; /* NULL when closed */
    size_t size_bytes;
    uint64_t mask;
    uint64_t epoch;
    uint64_t next_seq;     /* what imud_next gives next */
    uint64_t missed_total; /* samples missed since imud_open */
    uint64_t torn_seq;     /* a slot that was not whole, and ... */
    uint64_t torn_newest;  /* ... the newest sequence number then */
    dev_t dev;
    ino_t ino;
    int fd;          /* of the mapped file, to look at its size */
    uid_t owner_uid; /* whose rings are believed beside those of root and of the directory's owner; 0: nobody's */
    char path[256];
    uint32_t crc_table[256];
} imud_ring;

static inline const char *imud_strerror(int error)
{
    switch (error) {
    case IMUD_E_MISSING: return "no such ring: is imud running, and is the device in its configuration?";
    case IMUD_E_DENIED: return "the ring may not be read: is this user in group imud?";
    case IMUD_E_FORMAT: return "the file is no ring of imud";
    case IMUD_E_VERSION: return "the ring has another layout version: build with the imud.h of the running daemon";
    case IMUD_E_NAME: return "expected a device name or a path of less than 256 characters";
    case IMUD_E_ENDED: return "the daemon ended the descriptor: connect to its socket and ask for another";
    case IMUD_E_OWNER:
        return "the file belongs neither to root nor to the owner of its directory: if that is the daemon's user, name it "
               "(imud_open_owned)";
    case IMUD_E_SYSTEM: return strerror(errno);
    default: return "no error";
    }
}

static inline int64_t imud_now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

/* ---- inner parts --------------------------------------------------------------------------------------------- */

/* CRC-32 of IEEE 802.3, reflected polynomial 0xEDB88320. */
static inline void imud_crc_init_(uint32_t table[256])
{
    for (uint32_t i = 0; i < 256; i++) {
        uint32_t value = i;
        for (int bit = 0; bit < 8; bit++)
            value = (value >> 1) ^ ((value & 1u) ? 0xEDB88320u : 0u);
        table[i] = value;
    }
}

/* CRC-32 of bytes after bytes with the value `crc`; 0 for the first bytes. */
static inline uint32_t imud_crc_(const uint32_t table[256], uint32_t crc, const void *data, size_t size_bytes)
{
    const unsigned char *byte = (const unsigned char *)data;
    crc = ~crc;
    while (size_bytes--)
        crc = (crc >> 8) ^ table[(crc ^ *byte++) & 0xFFu];
    return ~crc;
}

static inline uint64_t imud_load_(const unsigned char *at)
{
    return __atomic_load_n((const uint64_t *)(const void *)at, __ATOMIC_ACQUIRE);
}

/* Copies a block of u64 words that may change meanwhile. Returns whether its first word, its sequence number, was the
 * same before, in, and after the copy. */
static inline int imud_copy_(const unsigned char *from, void *to, size_t size_bytes)
{
    uint64_t word, before = imud_load_(from);
    unsigned char *target = (unsigned char *)to;
    if (before == IMUD_SEQ_INVALID)
        return 0;
    for (size_t at = 0; at < size_bytes; at += 8) {
        word = __atomic_load_n((const uint64_t *)(const void *)(from + at), __ATOMIC_RELAXED);
        memcpy(target + at, &word, 8);
    }
    __atomic_thread_fence(__ATOMIC_ACQUIRE);
    return imud_load_(from) == before && memcmp(target, &before, 8) == 0;
}

static inline int imud_read_slot_(const imud_ring *ring, uint64_t seq, imud_slot *out)
{
    const unsigned char *slot = ring->base + IMUD_HEADER_BYTES + (seq & ring->mask) * IMUD_SLOT_BYTES;
    uint32_t crc;
    if (!imud_copy_(slot, out, IMUD_SLOT_BYTES) || out->seq != seq)
        return 0;
    crc = imud_crc_(ring->crc_table, 0, out, offsetof(imud_slot, crc32));
    if (out->present & (IMUD_HAS_VELOCITY | IMUD_HAS_POSITION))
        crc = imud_crc_(ring->crc_table, crc, out->velocity_enu_m_s,
                        IMUD_SLOT_BYTES - offsetof(imud_slot, velocity_enu_m_s));
    return out->crc32 == crc;
}

/* Oldest sample the ring can still hold when `newest` is its newest; newest + 1 when it holds none. */
static inline uint64_t imud_oldest_(const imud_ring *ring, uint64_t newest)
{
    uint64_t first = imud_load_(ring->base + offsetof(imud_header, first_seq));
    uint64_t kept = newest > ring->mask ? newest - ring->mask : 1;
    /* newest + 1: it holds none yet. Above that, `first` is seen before the newest it belongs to. */
    return first > kept && first - 1 <= newest ? first : kept;
}

static inline int imud_errno_(void)
{
    if (errno == ENOENT)
        return IMUD_E_MISSING;
    if (errno == ELOOP || errno == ENXIO) /* a symbolic link, a socket */
        return IMUD_E_FORMAT;
    return errno == EACCES || errno == EPERM ? IMUD_E_DENIED : IMUD_E_SYSTEM;
}

static inline int imud_check_(const imud_header *header, uint64_t size_bytes)
{
    uint64_t count = header->slot_count;
    if (memcmp(header->magic, IMUD_MAGIC, 8) != 0)
        return IMUD_E_FORMAT;
    if (header->layout_version != IMUD_LAYOUT_VERSION || header->slot_layout_version != IMUD_SLOT_LAYOUT_VERSION ||
        header->header_bytes != IMUD_HEADER_BYTES || header->slot_bytes != IMUD_SLOT_BYTES)
        return IMUD_E_VERSION;
    if (count == 0 || (count & (count - 1)) || header->ledger_count > IMUD_LEDGER_ROOM ||
        count > (SIZE_MAX - IMUD_HEADER_BYTES) / IMUD_SLOT_BYTES ||
        size_bytes < IMUD_HEADER_BYTES + count * IMUD_SLOT_BYTES)
        return IMUD_E_FORMAT;
    return 0;
}

/* Reads the header of an open file and checks it against the file's type and size. The mapped one is not used for that:
 * a writer that means harm could change it between the check and its use. */
static inline int imud_look_(int fd, imud_header *header, struct stat *status)
{
    ssize_t length;
    if (fstat(fd, status) != 0)
        return imud_errno_();
    if (!S_ISREG(status->st_mode) || status->st_size < (off_t)IMUD_HEADER_BYTES)
        return IMUD_E_FORMAT;
    length = pread(fd, header, sizeof *header, 0);
    if (length < 0)
        return imud_errno_();
    return length == (ssize_t)sizeof *header ? imud_check_(header, (uint64_t)status->st_size) : IMUD_E_FORMAT;
}

/* Whether a file of user `uid` at ring->path is to be believed: its owner is root, the owner of the directory, who may
 * replace every file in it anyway, or the user that was named. The header's pid is no proof: it can be forged. */
static inline int imud_check_owner_(const imud_ring *ring, uid_t uid)
{
    char directory[sizeof ring->path];
    struct stat status;
    size_t length = (size_t)(strrchr(ring->path, '/') - ring->path) + 1; /* with the slash: "/" is one too */
    if (uid == 0 || uid == ring->owner_uid)
        return 0;
    memcpy(directory, ring->path, length);
    directory[length] = 0;
    if (stat(directory, &status) != 0)
        return imud_errno_();
    return status.st_uid == uid ? 0 : IMUD_E_OWNER;
}

/* Maps the file at ring->path into ring; leaves ring as it was on error. Follows no symbolic link and does not wait for
 * the writer of a FIFO. */
static inline int imud_map_(imud_ring *ring)
{
    struct stat status;
    imud_header header;
    size_t size_bytes;
    void *base;
    int error, fd = open(ring->path, O_RDONLY | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK);
    if (fd < 0)
        return imud_errno_();
    error = imud_look_(fd, &header, &status);
    if (!error)
        error = imud_check_owner_(ring, status.st_uid);
    if (error) {
        close(fd);
        return error;
    }
    size_bytes = IMUD_HEADER_BYTES + (size_t)header.slot_count * IMUD_SLOT_BYTES;
    base = mmap(NULL, size_bytes, PROT_READ, MAP_SHARED, fd, 0);
    if (base == MAP_FAILED) {
        error = imud_errno_();
        close(fd);
        return error;
    }
    if (ring->base) {
        munmap((void *)(uintptr_t)ring->base, ring->size_bytes);
        close(ring->fd);
    }
    ring->base = (const unsigned char *)base;
    ring->size_bytes = size_bytes;
    ring->mask = header.slot_count - 1u;
    ring->epoch = header.epoch;
    ring->torn_seq = 0;
    ring->dev = status.st_dev;
    ring->ino = status.st_ino;
    ring->fd = fd;
    return 0;
}

/* Sets ring->path to that of a device in a directory, and maps it. */
static inline int imud_map_in_(imud_ring *ring, const char *directory, const char *rest, const char *device)
{
    int length = snprintf(ring->path, sizeof ring->path, "%s%s/imud.%s", directory, rest, device);
    return length < 0 || (size_t)length >= sizeof ring->path ? IMUD_E_NAME : imud_map_(ring);
}

/* Looks a device up in the directories where rings may be. */
static inline int imud_find_(imud_ring *ring, const char *device)
{
    const char *named = getenv("IMUD_SHM"), *own = getenv("XDG_RUNTIME_DIR");
    int error;
    if (named && *named)
        return imud_map_in_(ring, named, "", device);
    error = imud_map_in_(ring, "/run/imud/shm", "", device);
    if (error != IMUD_E_MISSING || !own || *own != '/')
        return error;
    error = imud_map_in_(ring, own, "/imud/shm", device);
    if (error == IMUD_E_MISSING || error == IMUD_E_NAME)
        error = imud_map_in_(ring, "/run/imud/shm", "", device); /* the path that a message should name */
    return error;
}

/* ---- what you call ------------------------------------------------------------------------------------------- */

/* The header: names, sizes, epoch, process. Read `driver` and `ledger` with imud_read_ledger instead. */
static inline const imud_header *imud_get_header(const imud_ring *ring)
{
    return (const imud_header *)(const void *)ring->base;
}

/* Sequence number of the newest sample, 0 before the first. */
static inline uint64_t imud_newest_seq(const imud_ring *ring)
{
    return imud_load_(ring->base + offsetof(imud_header, newest_seq));
}

/* Opens as imud_open does a ring that may also belong to `owner_uid`: the user that the daemon runs as, for a directory
 * where every user may make files. Returns as imud_open. */
static inline int imud_open_owned(imud_ring *ring, const char *device_or_path, uid_t owner_uid)
{
    size_t length = strlen(device_or_path);
    int error;
    memset(ring, 0, sizeof *ring);
    ring->owner_uid = owner_uid;
    if (length == 0 || length >= sizeof ring->path)
        return IMUD_E_NAME;
    imud_crc_init_(ring->crc_table);
    if (strchr(device_or_path, '/')) {
        memcpy(ring->path, device_or_path, length + 1);
        error = imud_map_(ring);
    } else {
        error = imud_find_(ring, device_or_path);
    }
    if (!error)
        ring->next_seq = imud_newest_seq(ring) + 1;
    return error;
}

/* Opens the ring of a device, or a path if there is a '/' in it; it must belong to root or to the owner of its directory.
 * imud_next will give the samples that come after this call. Returns 0 or IMUD_E_...; after an error the ring is
 * closed. */
static inline int imud_open(imud_ring *ring, const char *device_or_path)
{
    return imud_open_owned(ring, device_or_path, 0);
}

/* Releases the ring; may be called twice. */
static inline void imud_close(imud_ring *ring)
{
    if (ring->base) {
        munmap((void *)(uintptr_t)ring->base, ring->size_bytes);
        close(ring->fd);
    }
    ring->base = NULL;
}

/* Whether there is a daemon behind the ring. `now_ns` is imud_now_ns(). One system call. */
static inline imud_health_state imud_health(const imud_ring *ring, int64_t now_ns)
{
    const uint32_t *state = (const uint32_t *)(const void *)(ring->base + offsetof(imud_header, state));
    uint64_t age_ns;
    if (lseek(ring->fd, 0, SEEK_END) < (off_t)ring->size_bytes)
        return IMUD_HEALTH_CLOSED;
    if (__atomic_load_n(state, __ATOMIC_ACQUIRE) != IMUD_STATE_LIVE)
        return IMUD_HEALTH_CLOSED;
    age_ns = (uint64_t)now_ns - imud_load_(ring->base + offsetof(imud_header, heartbeat_ns));
    /* Either way round: it may have come after `now_ns` was read; but one far in the future is no sign of life. */
    if (age_ns + IMUD_HEARTBEAT_LIMIT_NS - 1 < 2u * IMUD_HEARTBEAT_LIMIT_NS - 1)
        return IMUD_HEALTH_LIVE;
    return IMUD_HEALTH_STALE;
}

/* Maps the ring that has the path now. Returns 1 if it is a new one, 0 if the mapped one is still the one there is,
 * IMUD_E_... if there is none; the old one stays mapped then. Samples of a new ring come from the first on, or where
 * the same daemon goes on with its numbers, from the last one read on; those it no longer holds count as missed. */
static inline int imud_reopen(imud_ring *ring)
{
    struct stat status;
    uint64_t epoch = ring->epoch;
    int error;
    if (lstat(ring->path, &status) != 0)
        return imud_errno_();
    if (status.st_dev == ring->dev && status.st_ino == ring->ino)
        return 0;
    error = imud_map_(ring);
    if (error)
        return error;
    if (ring->epoch != epoch || imud_load_(ring->base + offsetof(imud_header, first_seq)) < ring->next_seq)
        ring->next_seq = 1;
    return 1;
}

/* The newest sample. Returns 1, or 0 if there is none (or none whole just now). Does not move imud_next. */
static inline int imud_latest(const imud_ring *ring, imud_slot *out)
{
    for (int attempt = 0; attempt < 3; attempt++) { /* the writer may overtake one copy, hardly three */
        uint64_t newest = imud_newest_seq(ring);
        if (newest == 0)
            return 0;
        if (imud_read_slot_(ring, newest, out))
            return 1;
    }
    return 0;
}

/* The next sample in order. Returns 1, or 0 if there is none yet. `missed` (may be NULL) is set to how many samples
 * were overwritten before they could be read since the call before. */
static inline int imud_next(imud_ring *ring, imud_slot *out, uint64_t *missed)
{
    uint64_t newest = imud_newest_seq(ring), oldest, lost = 0;
    int got = 0;
    if (newest && newest + 1 < ring->next_seq) /* the numbers began anew in the same ring */
        ring->next_seq = imud_oldest_(ring, newest);
    while (!got && newest >= ring->next_seq) {
        oldest = imud_oldest_(ring, newest);
        if (oldest > ring->next_seq) {
            lost += oldest - ring->next_seq;
            ring->next_seq = oldest;
        }
        got = imud_read_slot_(ring, ring->next_seq, out);
        if (got) {
            ring->next_seq++;
            break;
        }
        newest = imud_newest_seq(ring);
        if (imud_oldest_(ring, newest) > ring->next_seq)
            continue; /* overtaken while copying */
        if (ring->torn_seq != ring->next_seq) { /* not whole yet: a later call will find it so */
            ring->torn_seq = ring->next_seq;
            ring->torn_newest = newest;
        }
        if (newest == ring->torn_newest)
            break;
        lost++; /* newer ones were finished meanwhile and this one still is not: it never will be */
        ring->next_seq++;
    }
    ring->missed_total += lost;
    if (missed)
        *missed = lost;
    return got;
}

/* The ledger and the driver in use. Returns 1, or 0 if there is none (or none whole just now). */
static inline int imud_read_ledger(const imud_ring *ring, imud_ledger *out)
{
    const unsigned char *block = ring->base + offsetof(imud_header, ledger_update);
    for (int attempt = 0; attempt < 3; attempt++)
        if (imud_load_(block) != 0 && imud_copy_(block, out, sizeof *out) &&
            imud_crc_(ring->crc_table, 0, out, offsetof(imud_ledger, crc32)) == out->crc32)
            return 1;
    return 0;
}

/* Waits until the descriptor is readable, and drains it. It comes from imud's UNIX socket, method `notify` (SCM_RIGHTS);
 * -1 stands for none, then this only waits. Returns 1, or 0 after `timeout_ms` (-1: never), or IMUD_E_ENDED when the
 * daemon ended it (it would be readable for ever), or IMUD_E_SYSTEM (errno EINTR after a signal). */
static inline int imud_wait(int wake_fd, int timeout_ms)
{
    struct pollfd poller;
    char bytes[256]; /* far more than wait in it: one read takes all */
    ssize_t size_bytes;
    int ready;
    poller.fd = wake_fd;
    poller.events = POLLIN;
    poller.revents = 0;
    ready = poll(&poller, 1, timeout_ms);
    if (ready <= 0)
        return ready < 0 ? IMUD_E_SYSTEM : 0;
    size_bytes = read(wake_fd, bytes, sizeof bytes);
    if (size_bytes == 0)
        return IMUD_E_ENDED;
    return size_bytes > 0 || errno == EAGAIN ? 1 : IMUD_E_SYSTEM; /* EAGAIN: another thread was faster */
}

#endif
