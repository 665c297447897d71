/* Commands of the tests of imud.h; each prints what it found. C99 and C++. */
static void after_copy(void);
/* imud.h calls its fence once, right after a copy: there a test lets the writer come in between. */
#define __atomic_thread_fence(order) after_copy()
#include "imud.h"

#include <inttypes.h>
#include <stdlib.h>

static const char *poke_path;
static long poke_at;
static char poke_byte;
static int poke_times;

static void after_copy(void)
{
    if (poke_times > 0) {
        FILE *file = fopen(poke_path, "r+b");
        poke_times--;
        if (!file || fseek(file, poke_at, SEEK_SET) || fputc(poke_byte, file) == EOF || fclose(file))
            abort();
    }
}

static void show(const imud_slot *s)
{
    printf("%" PRIu64 " %" PRId64 " %" PRId64 " %" PRId64 " %" PRIu32 " %" PRIu32 " %u %u", s->seq, s->t_ns, s->t_rx_ns,
           s->utc_ns, s->t_err_ns, s->present, (unsigned)s->device_id, (unsigned)s->sync);
    for (int i = 0; i < 3; i++)
        printf(" %.17g %.17g", s->accel_m_s2[i], s->gyro_rad_s[i]);
    printf(" %.17g\n", s->temperature_c);
}

static void next(imud_ring *ring)
{
    imud_slot slot;
    uint64_t missed = 0;
    int got = imud_next(ring, &slot, &missed);
    printf("next %d %" PRIu64 " %" PRIu64 "\n", got, got == 1 ? slot.seq : 0, missed);
}

/* Reads to the end of the ring as fast as it can; every value of a sample must agree with its number. */
static int stress(imud_ring *ring)
{
    imud_slot slot;
    uint64_t missed, got = 0, lost = 0, torn = 0;
    int64_t end_ns = imud_now_ns() + 20000000000;
    printf("ready\n");
    fflush(stdout);
    while (imud_now_ns() < end_ns) {
        int closed = imud_health(ring, imud_now_ns()) == IMUD_HEALTH_CLOSED;
        while (imud_next(ring, &slot, &missed) == 1) {
            double value = (double)slot.seq;
            got++;
            lost += missed;
            missed = 0;
            if (slot.t_ns != (int64_t)slot.seq * 1000000 || slot.accel_m_s2[0] != value ||
                slot.accel_m_s2[2] != value + 0.5 || slot.gyro_rad_s[2] != value || slot.temperature_c != value / 8)
                torn++;
        }
        lost += missed;
        if (closed)
            break;
        poll(NULL, 0, 0);
    }
    printf("%" PRIu64 " %" PRIu64 " %" PRIu64 " %" PRIu64 "\n", got, lost, torn, ring->missed_total);
    return 0;
}

static int commands(imud_ring *ring)
{
    char line[512], word[16], text[256];
    imud_slot slot;
    imud_ledger ledger;
    long a, b, c;
    while (fgets(line, sizeof line, stdin)) {
        if (sscanf(line, "poke %255s %ld %ld %ld", text, &a, &b, &c) == 4) {
            poke_path = text;
            poke_at = a;
            poke_byte = (char)b;
            poke_times = (int)c;
            printf("poke\n");
        } else if (sscanf(line, "health %ld", &a) == 1) {
            printf("health %d\n", (int)imud_health(ring, a));
        } else if (sscanf(line, "wait %ld %ld", &a, &b) == 2) {
            printf("wait %d\n", imud_wait((int)a, (int)b));
        } else if (sscanf(line, "%15s", word) != 1) {
            continue;
        } else if (!strcmp(word, "next")) {
            next(ring);
        } else if (!strcmp(word, "sample") && imud_next(ring, &slot, NULL) == 1) {
            show(&slot);
        } else if (!strcmp(word, "latest")) {
            int got = imud_latest(ring, &slot);
            printf("latest %d %" PRIu64 "\n", got, got == 1 ? slot.seq : 0);
        } else if (!strcmp(word, "reopen")) {
            int result = imud_reopen(ring);
            printf("reopen %d %" PRIu64 "\n", result, ring->epoch);
        } else if (!strcmp(word, "ledger")) {
            int got = imud_read_ledger(ring, &ledger);
            printf("ledger %d", got);
            for (int i = 0; got && i < (int)imud_get_header(ring)->ledger_count; i++)
                printf(" %" PRIu64, ledger.values[i]);
            printf(" %s\n", got ? ledger.driver : "");
        } else {
            printf("what?\n");
        }
        fflush(stdout);
    }
    return 0;
}

int main(int argc, char **argv)
{
    imud_ring ring;
    int error, result;
    if (argc != 3 && argc != 4)
        return 2;
    error = argc == 3 ? imud_open(&ring, argv[2]) : imud_open_owned(&ring, argv[2], (uid_t)atol(argv[3]));
    if (error) {
        printf("error %d %s\n", error, imud_strerror(error));
        return 1;
    }
    result = strcmp(argv[1], "stress") ? commands(&ring) : stress(&ring);
    imud_close(&ring);
    imud_close(&ring);
    return result;
}
