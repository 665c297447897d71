/* Fuzzer of imud.h: an input is a program that writes a ring's file while it is read. tests/fuzz/shm.py has the steps
 * and makes the ring (IMUD_FUZZ_RING); both run the same inputs. */
#define _GNU_SOURCE
#include "imud.h"

#include <stdlib.h>

enum { SLOTS = 8, SIZE = IMUD_HEADER_BYTES + SLOTS * IMUD_SLOT_BYTES, CUT = 64, WRITE_MAX = 31 };
enum { READ, LATEST, LEDGER, HEALTH, WRITE, MEND_SLOT, MEND_LEDGER, REPLACE };

#define CHECK(condition) \
    do { \
        if (!(condition)) { \
            fprintf(stderr, "%s:%d: %s does not hold\n", __FILE__, __LINE__, #condition); \
            abort(); \
        } \
    } while (0)

static const int64_t NOW_NS = 5000000000;
static unsigned char base[SIZE], image[SIZE];
static size_t image_bytes;
static char path[64], other[64];
static int file = -1;
static uint32_t table[256];

static void remove_files(void)
{
    unlink(path);
    unlink(other);
}

int LLVMFuzzerInitialize(int *argc, char ***argv)
{
    const char *name = getenv("IMUD_FUZZ_RING");
    FILE *ring = name ? fopen(name, "rb") : NULL;
    (void)argc;
    (void)argv;
    CHECK(ring && fread(base, 1, SIZE, ring) == SIZE);
    fclose(ring);
    snprintf(path, sizeof path, "/dev/shm/imud.fuzz-%ld", (long)getpid());
    snprintf(other, sizeof other, "%s.new", path);
    imud_crc_init_(table);
    atexit(remove_files);
    return 0;
}

/* Writes the whole image to a new file. */
static void make(const char *name)
{
    file = open(name, O_RDWR | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
    CHECK(file >= 0 && write(file, image, image_bytes) == (ssize_t)image_bytes);
}

static void put(size_t at, const void *data, size_t size_bytes)
{
    if (at >= image_bytes)
        return;
    if (size_bytes > image_bytes - at)
        size_bytes = image_bytes - at;
    memcpy(image + at, data, size_bytes);
    CHECK(pwrite(file, data, size_bytes, (off_t)at) == (ssize_t)size_bytes);
}

static void mend(size_t begin, size_t crc_at)
{
    uint32_t crc = imud_crc_(table, 0, image + begin, crc_at - begin);
    put(crc_at, &crc, sizeof crc);
}

static void mend_slot(size_t begin)
{
    imud_slot slot;
    memcpy(&slot, image + begin, sizeof slot);
    slot.crc32 = imud_crc_(table, 0, &slot, offsetof(imud_slot, crc32));
    if (slot.present & (IMUD_HAS_VELOCITY | IMUD_HAS_POSITION))
        slot.crc32 = imud_crc_(table, slot.crc32, slot.velocity_enu_m_s, sizeof slot - offsetof(imud_slot, velocity_enu_m_s));
    put(begin + offsetof(imud_slot, crc32), &slot.crc32, sizeof slot.crc32);
}

static void replace(void)
{
    close(file);
    make(other);
    CHECK(rename(other, path) == 0);
}

static void look(imud_ring *ring, int kind)
{
    imud_slot slot;
    imud_ledger ledger;
    uint64_t missed = 0, before = ring->missed_total;
    int got = 0;
    switch (kind) {
    case READ:
        for (int count = 0; count <= SLOTS; count++) {
            got = imud_next(ring, &slot, &missed);
            CHECK(got == 0 || got == 1);
            CHECK(ring->missed_total == before + missed);
            before = ring->missed_total;
            if (!got)
                break;
            CHECK(ring->next_seq == slot.seq + 1);
        }
        CHECK(!got); /* no more samples than slots */
        break;
    case LATEST:
        got = imud_latest(ring, &slot);
        CHECK(got == 0 || (got == 1 && slot.seq == imud_newest_seq(ring)));
        break;
    case LEDGER:
        got = imud_read_ledger(ring, &ledger);
        CHECK(got == 0 || got == 1);
        break;
    case HEALTH:
        CHECK(imud_health(ring, NOW_NS) <= IMUD_HEALTH_STALE);
        break;
    case REPLACE:
        CHECK(imud_reopen(ring) <= 1);
        break;
    default:
        break;
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    imud_ring ring;
    size_t at = 2, length, offset;
    int opened = 0, steps = 0, kind;
    if (size < 2)
        return 0;
    image_bytes = SIZE > data[1] * CUT ? SIZE - data[1] * CUT : 0;
    memcpy(image, base, SIZE);
    make(path);
    for (; at < size; steps++) {
        if (!opened && steps >= data[0]) {
            if (imud_open_owned(&ring, path, getuid()) != 0)
                break;
            opened = 1;
        }
        kind = data[at++] % 8;
        if (kind == WRITE) {
            if (at + 3 > size)
                break;
            offset = (size_t)(data[at] | data[at + 1] << 8) % SIZE;
            length = data[at + 2] % (WRITE_MAX + 1);
            at += 3;
            put(offset, data + at, length < size - at ? length : size - at);
            at += length;
        } else if (kind == MEND_SLOT) {
            offset = IMUD_HEADER_BYTES + (at < size ? data[at] % SLOTS : 0) * IMUD_SLOT_BYTES;
            mend_slot(offset);
            at++;
        } else if (kind == MEND_LEDGER) {
            mend(offsetof(imud_header, ledger_update), offsetof(imud_header, ledger_crc32));
        } else if (kind == REPLACE) {
            replace();
        }
        if (opened)
            look(&ring, kind);
    }
    if (opened) {
        imud_strerror(imud_reopen(&ring));
        imud_close(&ring);
    }
    close(file);
    return 0;
}
