/* Fast path of samples: check the frames of a read, decode them, time-stamp them, and pack them as slots.
 *
 * A Run contains a copy of the state of clock and fit. `Run.stamp` does the same as the Python code and stops before the
 * first frame that is not usual. Python then copies the state back (`SampleClock.settle`) and continues with this frame.
 * The names are the names of the Python code:
 *
 *   is_usual_…, decode_… ─▶ HipnucCodec, Imu61xCodec (imud/drivers/hipnuc/uart/codec.py, …/imu61x/uart/codec.py)
 *   slewed ─▶ Slew.advance (imud/sampling/steering.py)
 *   add_stamp ─▶ StampTime (imud/sampling/stamp_time.py)
 *   stamp ─▶ add_even_run (imud/sampling/clock.py), ArrivalFit.add_arrival (imud/sampling/arrival_fit.py),
 *                 encode_slots (imud/formats/slot.py)
 *   receive, can_frames ─▶ FrameReader (imud/links/socketcan.py)
 *   write_ring, beat_ring, show_ledger ─▶ ShmRing (imud/publishers/shm.py)
 *   is_at ─▶ is_at (imud/formats/kernel.py)
 *   frame_slots ─▶ BinaryEncoding (imud/publishers/socket/outbox.py)
 *   add_slots ─▶ add_slots (imud/publishers/socket/history.py)
 *   evaluate ─▶ evaluate (imud/publishers/rules/limit.py)
 *   add_latencies ─▶ LatencyMeter.add (imud/sampling/meters.py), slot_status_bits (imud/formats/slot.py)
 *
 * The result must be equal to the result of Python in every bit. Therefore the compiler must not join a product and a
 * sum to one operation (-ffp-contract=off), and each expression has the order of the Python expression.
 */
#ifndef _GNU_SOURCE
#define _GNU_SOURCE /* recvmmsg, statx */
#endif
#define Py_LIMITED_API 0x030B0000
#include <Python.h>
#include <structmember.h>
#include <errno.h>
#include <fcntl.h>
#include <float.h>
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/sysmacros.h>
#include <unistd.h>

/* The headers of Python 3.12 and later do not count this reference, but Python 3.11 does. */
#undef Py_RETURN_NONE
#define Py_RETURN_NONE return Py_NewRef(Py_None)

#ifndef SOURCE_CRC
#error "compile the kernel with hatch_build.py, which defines the CRC-32 of this file"
#endif

#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "frames and slots are little-endian: use the Python code on this host"
#endif

#define HEAD_BYTES 6 /* header of a frame, before the payload */
#define HI91_HEAD "\x5a\xa5\x4c\x00" /* the payload has 76 bytes */
#define HI92_HEAD "\x5a\xa5\x30\x00" /* the payload has 48 bytes */
#define HIPNUC_HEAD_BYTES 4      /* the check value follows */
#define HI91_BYTES 76
#define HI92_BYTES 48
#define TAG_HI91 0x91
#define TAG_HI92 0x92
#define AHRS_HEAD "\xaa\x55\x02\x00\x2c\x00" /* identifier 2, the payload has 44 bytes and precedes the check value */
#define AHRS_BYTES 44
#define AHRS_CRC_BYTES 4
#define AHRS_CRC_START 1u        /* register before the first byte; no final inversion */
#define HI91_FLOATS 16           /* accel, gyro, mag, euler, quaternion */
#define HI92_COUNTS 9            /* gyro, accel, mag */
#define AHRS_FLOATS 10           /* pitch roll yaw, accel, gyro, temperature */
#define MORE_OFFSET 256          /* place of the bytes of a slot that HAS_MORE announces */
#define QUAT_SQUARE_MIN 0.9604   /* limits of the squared length of a rotation, see value_limits.py */
#define QUAT_SQUARE_MAX 1.0404
/* A float has this high byte or a larger one if it is not usual, also NaN: 32 g or more, other values 2048 or more */
#define ACCEL_HIGH_BYTE 0x42
#define VALUE_HIGH_BYTE 0x45
#define TURN_DEG 360.0f          /* maximum magnitude of a usual angle */
#define TEMPERATURE_MIN_C (-128.0f)
#define TEMPERATURE_MAX_C 150.0f
#define PRESSURE_MIN_PA 1000.0
#define PRESSURE_MAX_PA 120000.0
#define PPS_STAMP_MODULUS_MS 8192
#define HIPNUC_M_S2_PER_G 9.8
#define STANDARD_GRAVITY_M_S2 9.80665
#define RAD_PER_DEG (3.141592653589793 / 180)
#define T_PER_UT 1e-6
#define HI92_M_S2_PER_LSB 0.0048828
#define HI92_RAD_S_PER_LSB 0.001
#define HI92_T_PER_LSB (0.030517 * T_PER_UT)
#define HI92_RAD_PER_LSB (0.001 * RAD_PER_DEG)
#define HI92_QUAT_PER_LSB 0.0001
#define HI92_PRESSURE_OFFSET_PA 100000.0
#define DRIFT 200e-6             /* maximum rate error of the device's crystal */
#define LIVE_TICKS 640           /* `StampTime` compares values and arrivals over this time, ms */
#define LIVE_BREAK_NS 40000000
#define TURN_LATE_NS 4e8         /* before a later frame, the value can have restarted */
#define NS_PER_MS 1000000
#define EARLY_NS (-5e6)          /* an earlier frame can be a jump of the device counter */
#define JUMP_LATE_NS 5e8         /* a later frame can be a jump of the device counter */
#define SLEW 500e-6              /* limits of `Slew`, imud/sampling/steering.py */
#define SLEW_SETTLING 0.2
#define SETTLED_AFTER_NS INT64_C(10000000000)
#define T_ERR_MOST 4294967295.0
/* Maximum magnitude of times, ns: 36 years of CLOCK_MONOTONIC. Sums of some of them thus fit into 64 bits. Python has
 * no limit. The offset of UTC may be four times as large. */
#define TIME_MOST_NS (INT64_C(1) << 60)

enum { HAS_T_DEV = 1 << 0, HAS_ACCEL = 1 << 1, HAS_GYRO = 1 << 2, HAS_MAG = 1 << 3, HAS_QUAT = 1 << 4,
       HAS_EULER = 1 << 5, HAS_TEMPERATURE = 1 << 6, HAS_PRESSURE = 1 << 7, HAS_STATUS = 1 << 9, HAS_PPS_AGE = 1 << 10,
       HAS_MORE = 3 << 12 /* velocity, position */ };

/* The kernel makes only slots without the fields since layout version 2: these bytes are 0 and not part of the CRC. */

typedef struct {
    uint64_t seq;
    int64_t t_ns, t_rx_ns, utc_ns, t_dev_ns;
    uint64_t edge_seq;
    uint32_t t_err_ns, present, status;
    uint16_t device_id;
    uint8_t sync, reserved0;
    double accel_m_s2[3], gyro_rad_s[3], mag_t[3], quat_wxyz[4], euler_rad[3], temperature_c, pressure_pa, incli_rad[2];
    uint32_t pps_age_ms;
    uint8_t position_quality, position_satellites, reserved1[2];
    int64_t gnss_utc_ns;
    double heave_m;
    uint8_t reserved2[4];
    uint32_t crc32;
    double velocity_enu_m_s[3], latitude_rad, longitude_rad, height_m;
    uint8_t reserved3[16];
} Slot;

_Static_assert(sizeof(Slot) == 320 && offsetof(Slot, velocity_enu_m_s) == MORE_OFFSET, "a slot has 320 bytes without padding");

/* Open bin of the fit (`_Bin`), and the number of arrivals that were added to it. */
typedef struct {
    int64_t device_ns, arrival_ns, count, late, added;
    double lowest, wait, wait_least, wait_most, late_ns;
} Bin;

/* State of `StampTime`: ticks of 1 ms from a value that restarts after PPS_STAMP_MODULUS_MS. */
typedef struct {
    int in_use;
    int64_t stamp, before, ticks, arrival_ns, origin_ns, live_ticks, live_arrival_ns;
    double lowest_ns;
} Stamps;

typedef struct Format Format;

/* State of codec, clock, host and fit at the start of a run. */
typedef struct {
    const Format *format;
    int word_is_status, device_id, sync;
    int64_t own_status; /* -1: none */
    int64_t seq, t_ns, t_rx_ns, utc_offset_ns, byte_ns, waited_ns;
    double bias_ns, fit_error_ns;
    int64_t offset_ns, even_from_ns;
    int64_t ticks, device_ns, raw_ns, tick_ns;
    double period_ticks, doubt_ns;
    int64_t ref_arrival_ns, ref_device_ns, fitted_ns, until_ns;
    double slope, slope_error, wait_most;
    int64_t fit_begin_ns;
    double left_ns; /* of `Slew` */
    Bin bin;
    Stamps stamps;
} Run;

/* Format of a frame: a header of HEAD_BYTES, a payload that contains the device counter, and perhaps a check value. */
struct Format {
    const char *name;
    int frame_bytes;
    int ticks_offset;   /* place of the device counter in the payload */
    int has_stamp;      /* whether the counter is the value of `StampTime`, 16 bits; otherwise it has 32 bits */
    int (*is_usual)(const uint8_t *frame);
    uint32_t (*decode)(Slot *slot, const uint8_t *payload, int word_is_status); /* returns the bits of `present` */
};

/* table k: effect of a byte that k bytes follow */
static uint16_t crc16_table[8][256];
static uint32_t crc32_table[8][256];

static void make_tables(void)
{
    for (int byte = 0; byte < 256; byte++) {
        uint16_t crc16 = (uint16_t)(byte << 8);
        uint32_t crc32 = (uint32_t)byte;
        for (int bit = 0; bit < 8; bit++) {
            crc16 = (uint16_t)((crc16 << 1) ^ (crc16 & 0x8000 ? 0x1021 : 0));
            crc32 = (crc32 >> 1) ^ (crc32 & 1 ? 0xEDB88320u : 0);
        }
        crc16_table[0][byte] = crc16;
        crc32_table[0][byte] = crc32;
    }
    for (int k = 1; k < 8; k++)
        for (int byte = 0; byte < 256; byte++) {
            uint32_t before = crc32_table[k - 1][byte];
            uint16_t before16 = crc16_table[k - 1][byte];
            crc32_table[k][byte] = (before >> 8) ^ crc32_table[0][before & 0xFF];
            crc16_table[k][byte] = (uint16_t)((before16 << 8) ^ crc16_table[0][before16 >> 8]);
        }
}

/* Return the CRC-16 of `size` bytes after bytes with the value `crc`, as binascii.crc_hqx. Eight bytes per step. */
static uint16_t crc16_xmodem(const uint8_t *data, size_t size, uint16_t crc)
{
    for (; size >= 8; data += 8, size -= 8)
        crc = crc16_table[7][data[0] ^ crc >> 8] ^ crc16_table[6][data[1] ^ (crc & 0xFF)] ^ crc16_table[5][data[2]] ^
              crc16_table[4][data[3]] ^ crc16_table[3][data[4]] ^ crc16_table[2][data[5]] ^ crc16_table[1][data[6]] ^
              crc16_table[0][data[7]];
    for (; size; data++, size--)
        crc = (uint16_t)((crc << 8) ^ crc16_table[0][(crc >> 8) ^ *data]);
    return crc;
}

/* Return the register of the CRC-32 of zlib after `size` bytes, from the register `crc`. Eight bytes per step. */
static uint32_t crc32_register(const uint8_t *data, size_t size, uint32_t crc)
{
    for (; size >= 8; data += 8, size -= 8) {
        uint32_t low, high;
        memcpy(&low, data, 4);
        memcpy(&high, data + 4, 4);
        low ^= crc;
        crc = crc32_table[7][low & 0xFF] ^ crc32_table[6][low >> 8 & 0xFF] ^ crc32_table[5][low >> 16 & 0xFF] ^
              crc32_table[4][low >> 24] ^ crc32_table[3][high & 0xFF] ^ crc32_table[2][high >> 8 & 0xFF] ^
              crc32_table[1][high >> 16 & 0xFF] ^ crc32_table[0][high >> 24];
    }
    for (; size; data++, size--)
        crc = (crc >> 8) ^ crc32_table[0][(crc ^ *data) & 0xFF];
    return crc;
}

static uint32_t crc32_of(const uint8_t *data, size_t size)
{
    return ~crc32_register(data, size, UINT32_MAX);
}

/* Return whether a frame starts with `head` and `tag`, and has the correct check value. */
static int is_hipnuc(const uint8_t *frame, const char *head, int tag, size_t payload_bytes)
{
    const uint8_t *payload = frame + HEAD_BYTES;
    return !memcmp(frame, head, HIPNUC_HEAD_BYTES) && payload[0] == tag &&
           crc16_xmodem(payload, payload_bytes, crc16_xmodem(frame, HIPNUC_HEAD_BYTES, 0)) ==
               (uint16_t)(frame[4] | frame[5] << 8);
}

/* Return whether the magnitudes of `count` floats are usual by their high bytes. */
static int are_usual(const uint8_t *floats, int count, int high_byte)
{
    for (int i = 0; i < count; i++)
        if ((floats[4 * i + 3] & 0x7F) >= high_byte)
            return 0;
    return 1;
}

/* Return whether no angle is beyond a full turn. False for NaN. */
static int are_angles(const uint8_t *floats)
{
    float angles_deg[3];
    memcpy(angles_deg, floats, sizeof angles_deg);
    return fabsf(angles_deg[0]) <= TURN_DEG && fabsf(angles_deg[1]) <= TURN_DEG && fabsf(angles_deg[2]) <= TURN_DEG;
}

static void scale(double *to, const float *from, double factor)
{
    for (int i = 0; i < 3; i++)
        to[i] = from[i] * factor;
}

static uint32_t put_quat(Slot *slot, double w, double x, double y, double z)
{
    double square = w * w + x * x + y * y + z * z;
    if (!(QUAT_SQUARE_MIN < square && square < QUAT_SQUARE_MAX))
        return 0;
    slot->quat_wxyz[0] = w;
    slot->quat_wxyz[1] = x;
    slot->quat_wxyz[2] = y;
    slot->quat_wxyz[3] = z;
    return HAS_QUAT;
}

/* Write the temperature in a byte. The ends of the range are filler bytes. */
static uint32_t put_temperature(Slot *slot, uint8_t byte)
{
    if (byte == 0x7F || byte == 0x80)
        return 0;
    slot->temperature_c = (int8_t)byte;
    return HAS_TEMPERATURE;
}

/* Return whether a usual HI91 frame starts at `frame`: correct check value, possible values, and a known pressure. */
static int is_usual_hi91(const uint8_t *frame)
{
    const uint8_t *payload = frame + HEAD_BYTES;
    float pressure_pa;
    memcpy(&pressure_pa, payload + 4, 4);
    return is_hipnuc(frame, HI91_HEAD, TAG_HI91, HI91_BYTES) && are_usual(payload + 12, 3, ACCEL_HIGH_BYTE) &&
           are_usual(payload + 24, HI91_FLOATS - 3, VALUE_HIGH_BYTE) && are_angles(payload + 48) &&
           PRESSURE_MIN_PA <= pressure_pa && pressure_pa <= PRESSURE_MAX_PA; /* false for NaN */
}

/* Write the values of a usual frame into a slot, which contains zeros. */
static uint32_t decode_hi91(Slot *slot, const uint8_t *payload, int word_is_status)
{
    float pressure_pa, floats[HI91_FLOATS];
    unsigned word = payload[1] + 256u * payload[2];
    uint32_t present = HAS_T_DEV | HAS_ACCEL | HAS_GYRO | HAS_EULER | HAS_PRESSURE;
    memcpy(&pressure_pa, payload + 4, 4);
    memcpy(floats, payload + 12, sizeof floats);
    scale(slot->accel_m_s2, floats, HIPNUC_M_S2_PER_G);
    scale(slot->gyro_rad_s, floats + 3, RAD_PER_DEG);
    scale(slot->euler_rad, floats + 9, RAD_PER_DEG);
    /* a device without magnetometer sends zeros */
    if (floats[6] || floats[7] || floats[8]) {
        present |= HAS_MAG;
        scale(slot->mag_t, floats + 6, T_PER_UT);
    }
    slot->pressure_pa = pressure_pa;
    if (word <= PPS_STAMP_MODULUS_MS) {
        present |= word_is_status ? HAS_STATUS : HAS_PPS_AGE;
        *(word_is_status ? &slot->status : &slot->pps_age_ms) = word;
    }
    return present | put_quat(slot, floats[12], floats[13], floats[14], floats[15]) | put_temperature(slot, payload[3]);
}

static void angles_of(double *euler_rad, const uint8_t *payload)
{
    int32_t counts[3];
    memcpy(counts, payload + 28, sizeof counts);
    for (int i = 0; i < 3; i++)
        euler_rad[i] = counts[i] * HI92_RAD_PER_LSB;
}

/* Return whether a usual HI92 frame starts at `frame`: correct check value, possible angles, and a known counter. */
static int is_usual_hi92(const uint8_t *frame)
{
    const uint8_t *payload = frame + HEAD_BYTES;
    double euler_rad[3];
    angles_of(euler_rad, payload);
    for (int i = 0; i < 3; i++)
        if (!(fabs(euler_rad[i]) <= (double)TURN_DEG * RAD_PER_DEG))
            return 0;
    return payload[4] + 256 * payload[5] <= PPS_STAMP_MODULUS_MS &&
           is_hipnuc(frame, HI92_HEAD, TAG_HI92, HI92_BYTES);
}

static uint32_t decode_hi92(Slot *slot, const uint8_t *payload, int word_is_status)
{
    int16_t pressure, counts[HI92_COUNTS], quat[4];
    uint32_t present = HAS_T_DEV | HAS_ACCEL | HAS_GYRO | HAS_EULER | HAS_PPS_AGE;
    memcpy(&pressure, payload + 6, sizeof pressure);
    memcpy(counts, payload + 10, sizeof counts);
    memcpy(quat, payload + 40, sizeof quat);
    for (int i = 0; i < 3; i++) {
        slot->gyro_rad_s[i] = counts[i] * HI92_RAD_S_PER_LSB;
        slot->accel_m_s2[i] = counts[3 + i] * HI92_M_S2_PER_LSB;
    }
    angles_of(slot->euler_rad, payload);
    const int16_t *field = counts + 6, x = field[0];
    /* filler bytes */
    if (x != field[1] || x != field[2] || (x != 0 && x != -1 && x != 0x7FFF && x != 0x7F7F && x != -0x8000)) {
        present |= HAS_MAG;
        for (int i = 0; i < 3; i++)
            slot->mag_t[i] = field[i] * HI92_T_PER_LSB;
    }
    double pressure_pa = pressure + HI92_PRESSURE_OFFSET_PA;
    if (pressure != 0 && pressure != -1 && pressure != 0x7FFF && pressure != -0x8000 &&
        pressure_pa <= PRESSURE_MAX_PA) {
        present |= HAS_PRESSURE;
        slot->pressure_pa = pressure_pa;
    }
    slot->pps_age_ms = payload[4] + 256u * payload[5];
    (void)word_is_status; /* the manual reserves the status of HI92 */
    return present | put_temperature(slot, payload[3]) |
           put_quat(slot, quat[0] * HI92_QUAT_PER_LSB, quat[1] * HI92_QUAT_PER_LSB, quat[2] * HI92_QUAT_PER_LSB,
                    quat[3] * HI92_QUAT_PER_LSB);
}

/* Return whether a usual AHRS frame starts at `frame`: correct check value and possible values. */
static int is_usual_ahrs(const uint8_t *frame)
{
    const uint8_t *payload = frame + HEAD_BYTES;
    uint32_t crc;
    float temperature_c;
    memcpy(&crc, payload + AHRS_BYTES, sizeof crc);
    memcpy(&temperature_c, payload + 40, sizeof temperature_c);
    return !memcmp(frame, AHRS_HEAD, HEAD_BYTES) && are_angles(payload + 4) &&
           are_usual(payload + 16, 3, ACCEL_HIGH_BYTE) && are_usual(payload + 28, 3, VALUE_HIGH_BYTE) &&
           TEMPERATURE_MIN_C < temperature_c && temperature_c <= TEMPERATURE_MAX_C && /* false for NaN */
           crc32_register(frame, HEAD_BYTES + AHRS_BYTES, AHRS_CRC_START) == crc;
}

/* As `quat_from_euler_zyx` (imud/attitude/rotation.py). */
static uint32_t decode_ahrs(Slot *slot, const uint8_t *payload, int word_is_status)
{
    float floats[AHRS_FLOATS];
    memcpy(floats, payload + 4, sizeof floats);
    double roll = floats[1] * RAD_PER_DEG, pitch = floats[0] * RAD_PER_DEG, yaw = floats[2] * RAD_PER_DEG;
    double cr = cos(roll / 2), sr = sin(roll / 2), cp = cos(pitch / 2), sp = sin(pitch / 2);
    double cy = cos(yaw / 2), sy = sin(yaw / 2);
    slot->euler_rad[0] = roll;
    slot->euler_rad[1] = pitch;
    slot->euler_rad[2] = yaw;
    scale(slot->accel_m_s2, floats + 3, STANDARD_GRAVITY_M_S2);
    scale(slot->gyro_rad_s, floats + 6, RAD_PER_DEG);
    slot->temperature_c = floats[9];
    slot->quat_wxyz[0] = cy * cp * cr + sy * sp * sr;
    slot->quat_wxyz[1] = cy * cp * sr - sy * sp * cr;
    slot->quat_wxyz[2] = cy * sp * cr + sy * cp * sr;
    slot->quat_wxyz[3] = sy * cp * cr - cy * sp * sr;
    (void)word_is_status; /* the frame has no status */
    return HAS_T_DEV | HAS_ACCEL | HAS_GYRO | HAS_EULER | HAS_QUAT | HAS_TEMPERATURE;
}

static const Format formats[] = {
    {"HI91", HEAD_BYTES + HI91_BYTES, 8, 0, is_usual_hi91, decode_hi91},
    {"HI92", HEAD_BYTES + HI92_BYTES, 4, 1, is_usual_hi92, decode_hi92},
    {"AHRS", HEAD_BYTES + AHRS_BYTES + AHRS_CRC_BYTES, 0, 0, is_usual_ahrs, decode_ahrs},
};

/* Write the values of a usual frame into a slot, which contains zeros. */
static void decode(Slot *slot, const uint8_t *payload, const Run *run)
{
    uint32_t present = run->format->decode(slot, payload, run->word_is_status);
    if (run->own_status >= 0) {
        present |= HAS_STATUS;
        slot->status |= (uint32_t)run->own_status;
    }
    slot->present = present;
    slot->device_id = (uint16_t)run->device_id;
    slot->sync = (uint8_t)run->sync;
}

/* Add the value of a frame. Return 0 if the value did not rise, or if it can have restarted. */
static int add_stamp(Stamps *stamps, int64_t stamp, int64_t arrival_ns)
{
    int64_t step = stamp - stamps->stamp, elapsed_ns = arrival_ns - stamps->arrival_ns;
    if (step <= 0 || step >= PPS_STAMP_MODULUS_MS)
        return 0;
    stamps->before = stamps->ticks & UINT32_MAX;
    stamps->stamp = stamp;
    stamps->arrival_ns = arrival_ns;
    stamps->ticks += step;
    if (llabs(elapsed_ns - step * NS_PER_MS) > LIVE_BREAK_NS) {
        stamps->live_ticks = stamps->ticks;
        stamps->live_arrival_ns = arrival_ns;
    }
    stamps->lowest_ns += DRIFT * (double)elapsed_ns;
    double late_ns = (double)(arrival_ns - stamps->origin_ns - stamps->ticks * NS_PER_MS) - stamps->lowest_ns;
    if (stamps->ticks - stamps->live_ticks >= LIVE_TICKS) {
        stamps->live_ticks = stamps->ticks;
        stamps->live_arrival_ns = arrival_ns;
        if (!(late_ns < TURN_LATE_NS))
            return 0;
    }
    if (late_ns < 0.0)
        stamps->lowest_ns += late_ns;
    return 1;
}

/* Add an arrival to the open bin of the fit. */
static void add_arrival(Bin *bin, int64_t device_ns, int64_t arrival_ns, int64_t trailing_ns, double above_ns,
                        double wait_most)
{
    double wait = above_ns + trailing_ns;
    bin->added++;
    bin->count++;
    if (wait > wait_most) {
        bin->late++;
        bin->late_ns += wait - wait_most;
        wait = wait_most;
    }
    bin->wait += wait;
    if (wait < bin->wait_least)
        bin->wait_least = wait;
    else if (wait > bin->wait_most)
        bin->wait_most = wait;
    if (above_ns < bin->lowest) {
        bin->lowest = above_ns;
        bin->device_ns = device_ns;
        bin->arrival_ns = arrival_ns;
    }
}

/* Return the difference `left_ns` between published and estimated time after `elapsed_ns`. */
static double slewed(double left_ns, int64_t elapsed_ns, int64_t age_ns)
{
    double most = elapsed_ns * (age_ns > SETTLED_AFTER_NS ? SLEW : SLEW_SETTLING);
    return left_ns > most ? left_ns - most : left_ns < -most ? left_ns + most : 0.0;
}

/* Time-stamp and decode one frame. `trailing_bytes` follow it. Return 0 without a change if the frame is not usual. */
static int stamp(Run *run, double *error_ns, Slot *slot, const uint8_t *frame, int64_t trailing_bytes)
{
    const uint8_t *payload = frame + HEAD_BYTES;
    const Format *format = run->format;
    Stamps stamps = run->stamps;
    uint32_t ticks, step;
    int64_t trailing_ns = trailing_bytes * run->byte_ns;
    int64_t arrival_ns = run->t_rx_ns - (format->frame_bytes * run->byte_ns + trailing_ns + run->offset_ns);
    memcpy(&ticks, payload + format->ticks_offset, sizeof ticks);
    if (format->has_stamp) {
        if (!add_stamp(&stamps, ticks & UINT16_MAX, arrival_ns))
            return 0;
        ticks = (uint32_t)stamps.ticks;
    }
    step = ticks - (uint32_t)run->ticks;
    /* a gap, a repeated counter value, or a change of the host's rate */
    if (step != run->period_ticks || !step || arrival_ns < run->even_from_ns)
        return 0;
    int64_t step_ns = step * run->tick_ns, next_ns = run->device_ns + step_ns;
    double fit_ns = run->ref_arrival_ns + run->slope * (double)(next_ns - run->ref_device_ns);
    double left_ns = slewed(run->left_ns, step_ns, next_ns - run->fit_begin_ns);
    double above_ns = arrival_ns - fit_ns, wanted_ns = fit_ns - run->bias_ns + left_ns;
    int is_new = !run->waited_ns || above_ns <= 0.0; /* a held frame above the fit contains no new information */
    if (!is_new)
        above_ns = fmax(above_ns - run->waited_ns, 0.0);
    if (!(fabs(wanted_ns) < TIME_MOST_NS) || next_ns > TIME_MOST_NS || run->raw_ns > TIME_MOST_NS)
        return 0;
    int64_t steady_ns = (int64_t)wanted_ns, t_ns = steady_ns + run->offset_ns;
    *error_ns = run->fit_error_ns + run->slope_error * (double)(next_ns - run->fitted_ns) + run->doubt_ns +
                fabs(left_ns);
    /* an early or late frame, a fit that is due, or a time stamp that needs a correction */
    if (!(above_ns >= EARLY_NS && above_ns < JUMP_LATE_NS) || (is_new && next_ns >= run->until_ns) ||
        steady_ns < run->even_from_ns || steady_ns > arrival_ns || t_ns <= run->t_ns || t_ns > run->t_rx_ns ||
        !(*error_ns >= 0.0))
        return 0;
    if (is_new)
        add_arrival(&run->bin, next_ns, arrival_ns, trailing_ns, above_ns, run->wait_most);
    run->stamps = stamps;
    run->ticks = ticks;
    run->device_ns = next_ns;
    run->raw_ns += step_ns;
    run->left_ns = left_ns;
    run->t_ns = t_ns;
    run->seq++;
    memset(slot, 0, sizeof *slot);
    slot->seq = (uint64_t)run->seq;
    slot->t_ns = t_ns;
    slot->t_rx_ns = run->t_rx_ns;
    slot->utc_ns = t_ns + run->utc_offset_ns;
    slot->t_dev_ns = run->raw_ns;
    slot->t_err_ns = *error_ns < T_ERR_MOST ? (uint32_t)((int64_t)*error_ns + 1) : UINT32_MAX;
    decode(slot, payload, run);
    slot->crc32 = crc32_of((const uint8_t *)slot, offsetof(Slot, crc32));
    return 1;
}

static int is_in_range(const Run *run)
{
    const int64_t times_ns[] = {
        run->seq, run->t_ns, run->t_rx_ns, run->utc_offset_ns / 4, run->waited_ns, run->offset_ns, run->device_ns,
        run->raw_ns, run->ref_arrival_ns, run->ref_device_ns, run->fitted_ns, run->fit_begin_ns, run->bin.count, run->bin.late,
        run->stamps.arrival_ns, run->stamps.origin_ns, run->stamps.stamp, run->stamps.live_ticks,
    };
    for (size_t i = 0; i < sizeof times_ns / sizeof *times_ns; i++)
        if (times_ns[i] > TIME_MOST_NS || times_ns[i] < -TIME_MOST_NS)
            return 0;
    /* limits of the products: 1e9 ns per byte, and 1e6 ns per tick of a step below 2³² */
    return run->seq >= 0 && run->byte_ns >= 0 && run->byte_ns <= 1000000000 && run->tick_ns > 0 &&
           run->tick_ns <= 1000000 && run->own_status <= UINT32_MAX && run->device_id >= 0 &&
           run->device_id <= UINT16_MAX && run->stamps.ticks >= 0 && run->stamps.ticks <= TIME_MOST_NS / NS_PER_MS;
}

enum { DATA, WORD_IS_STATUS, T_RX_NS, UTC_OFFSET_NS, WAITED_NS, OFFSET_NS, EVEN_FROM_NS, ARGUMENTS };

/* A sequence of usual frames that Python did not interrupt. Python copies the changed state back with `state`. */
typedef struct {
    PyObject_HEAD
    Run run;
    int64_t frames; /* number of time-stamped frames */
    double error_ns; /* error of the newest time stamp */
    PyObject *known[ARGUMENTS]; /* arguments of the last `stamp`: most of them are the same objects in each call */
} RunObject;

static PyObject *run_type;

/* start(device_id, format, …state…) -> Run, or None if Python must process the next frame */
static PyObject *start(PyObject *self, PyObject *args)
{
    Run run;
    Bin *bin = &run.bin;
    Stamps *stamps = &run.stamps;
    const char *name;
    memset(&run, 0, sizeof run);
    if (!PyArg_ParseTuple(
            args, "is(iLLLLLdd)(LLLLddLLLLdddLd)(LLddddLLd)(pLLLLLLLd):start", &run.device_id, &name, &run.sync,
            &run.own_status,
            &run.seq, &run.t_ns, &run.t_rx_ns, &run.byte_ns, &run.bias_ns, &run.fit_error_ns, &run.ticks,
            &run.device_ns, &run.raw_ns, &run.tick_ns, &run.period_ticks, &run.doubt_ns, &run.ref_arrival_ns,
            &run.ref_device_ns, &run.fitted_ns, &run.until_ns, &run.slope, &run.slope_error, &run.wait_most,
            &run.fit_begin_ns, &run.left_ns, &bin->device_ns, &bin->arrival_ns, &bin->lowest, &bin->wait, &bin->wait_least, &bin->wait_most,
            &bin->count, &bin->late, &bin->late_ns, &stamps->in_use, &stamps->stamp, &stamps->before, &stamps->ticks,
            &stamps->arrival_ns, &stamps->origin_ns, &stamps->live_ticks, &stamps->live_arrival_ns, &stamps->lowest_ns))
        return NULL;
    for (size_t i = 0; i < sizeof formats / sizeof *formats; i++)
        if (!strcmp(name, formats[i].name))
            run.format = formats + i;
    if (run.format == NULL) {
        PyErr_Format(PyExc_ValueError, "start: expected a format of the kernel, got %s", name);
        return NULL;
    }
    /* the counter of the newest frame must be the value of `StampTime` */
    if (!is_in_range(&run) ||
        (run.format->has_stamp && !(stamps->in_use && (stamps->ticks & UINT32_MAX) == run.ticks)))
        Py_RETURN_NONE;
    RunObject *made = PyObject_New(RunObject, (PyTypeObject *)run_type);
    if (made == NULL)
        return NULL;
    made->run = run;
    made->frames = 0;
    made->error_ns = 0.0;
    memset(made->known, 0, sizeof made->known);
    return (PyObject *)made;
}

static int is_time(int64_t ns)
{
    return -TIME_MOST_NS <= ns && ns <= TIME_MOST_NS;
}

/* Read an integer of Python. Return 0 with an exception if it is not an integer of 64 bits. */
static int integer(PyObject *object, int64_t *value)
{
    *value = PyLong_AsLongLong(object);
    return *value != -1 || !PyErr_Occurred();
}

static void know(RunObject *self, int index, PyObject *const *args)
{
    PyObject *before = self->known[index];
    Py_INCREF(args[index]);
    self->known[index] = args[index];
    Py_XDECREF(before);
}

/* Read an argument of `stamp`, unless it is the object of the last call. */
static int learn(RunObject *self, int index, PyObject *const *args, int64_t *value)
{
    int64_t read;
    if (args[index] == self->known[index])
        return 1;
    if (!integer(args[index], &read))
        return 0;
    *value = read;
    know(self, index, args);
    return 1;
}

/* Run.stamp(data, word_is_status, t_rx_ns, utc_offset_ns, waited_ns, offset_ns, even_from_ns) -> slots of the usual
 * frames at the start of `data`; empty if the first frame needs Python */
static PyObject *stamp_frames(RunObject *self, PyObject *const *args, Py_ssize_t count)
{
    Run *run = &self->run;
    char *data;
    Py_ssize_t size, done = 0, frame_bytes = run->format->frame_bytes;
    int64_t t_rx_ns, t_rx_before_ns = run->t_rx_ns;
    if (count != ARGUMENTS) {
        PyErr_Format(PyExc_TypeError, "stamp: expected %d arguments, got %zd", ARGUMENTS, count);
        return NULL;
    }
    if (PyBytes_AsStringAndSize(args[DATA], &data, &size) < 0)
        return NULL;
    if (args[WORD_IS_STATUS] != self->known[WORD_IS_STATUS]) {
        int is_true = PyObject_IsTrue(args[WORD_IS_STATUS]);
        if (is_true < 0)
            return NULL;
        run->word_is_status = is_true;
        know(self, WORD_IS_STATUS, args);
    }
    if (!integer(args[T_RX_NS], &t_rx_ns) || !learn(self, UTC_OFFSET_NS, args, &run->utc_offset_ns) ||
        !learn(self, WAITED_NS, args, &run->waited_ns) || !learn(self, OFFSET_NS, args, &run->offset_ns) ||
        !learn(self, EVEN_FROM_NS, args, &run->even_from_ns))
        return NULL;
    if (t_rx_ns > run->t_rx_ns)
        run->t_rx_ns = t_rx_ns;
    Py_ssize_t most = size <= INT32_MAX && is_in_range(run) ? size / frame_bytes : 0;
    while (done < most && run->format->is_usual((const uint8_t *)data + done * frame_bytes))
        done++;
    PyObject *slots = PyBytes_FromStringAndSize(NULL, done * (Py_ssize_t)sizeof(Slot));
    if (slots == NULL) {
        run->t_rx_ns = t_rx_before_ns;
        return NULL;
    }
    Slot *slot = (Slot *)PyBytes_AsString(slots);
    most = done;
    for (done = 0; done < most; done++) {
        double error_ns;
        if (!stamp(run, &error_ns, slot + done, (const uint8_t *)data + done * frame_bytes,
                   size - (done + 1) * frame_bytes))
            break;
        self->error_ns = error_ns;
    }
    self->frames += done;
    if (!done)
        run->t_rx_ns = t_rx_before_ns;
    if (done < most) { /* the limited API cannot shorten bytes */
        PyObject *some = PyBytes_FromStringAndSize((const char *)slot, done * (Py_ssize_t)sizeof(Slot));
        Py_DECREF(slots);
        slots = some;
    }
    return slots;
}

/* Run.state() -> frames, ticks, seq, t_ns, t_rx_ns, error_ns, left_ns, bin, number of arrivals that were added to the
 * bin, and the state of `StampTime`, None if the format does not use it */
static PyObject *state_of(RunObject *self, PyObject *unused)
{
    const Run *run = &self->run;
    const Bin *bin = &run->bin;
    const Stamps *stamps = &run->stamps;
    PyObject *kept = run->format->has_stamp
                         ? Py_BuildValue("iLLLLLLLd", stamps->in_use, stamps->stamp, stamps->before, stamps->ticks,
                                         stamps->arrival_ns, stamps->origin_ns, stamps->live_ticks,
                                         stamps->live_arrival_ns, stamps->lowest_ns)
                         : Py_NewRef(Py_None);
    return Py_BuildValue("LLLLLdd(LLddddLLd)LN", self->frames, run->ticks, run->seq, run->t_ns, run->t_rx_ns,
                         self->error_ns, run->left_ns, bin->device_ns, bin->arrival_ns, bin->lowest, bin->wait, bin->wait_least,
                         bin->wait_most, bin->count, bin->late, bin->late_ns, bin->added, kept);
}

static void free_run(PyObject *self)
{
    PyTypeObject *type = Py_TYPE(self);
    for (int i = 0; i < ARGUMENTS; i++)
        Py_XDECREF(((RunObject *)self)->known[i]);
    PyObject_Free(self);
    Py_DECREF(type);
}

static PyMethodDef run_methods[] = {
    {"stamp", (PyCFunction)(void (*)(void))stamp_frames, METH_FASTCALL, "Return slots of the usual frames at the start of bytes."},
    {"state", (PyCFunction)state_of, METH_NOARGS, "Return the state after the newest frame."},
    {NULL, NULL, 0, NULL},
};

static PyMemberDef run_members[] = {
    {"t_ns", T_LONGLONG, offsetof(RunObject, run.t_ns), READONLY, "time stamp of the newest sample, ns"},
    {"t_rx_ns", T_LONGLONG, offsetof(RunObject, run.t_rx_ns), READONLY, "CLOCK_MONOTONIC of its read, ns"},
    {NULL, 0, 0, 0, NULL},
};

static PyType_Slot run_slots[] = {
    {Py_tp_methods, run_methods}, {Py_tp_members, run_members}, {Py_tp_dealloc, (void *)free_run}, {0, NULL},
};

static PyType_Spec run_spec = {
    "imud._kernel.Run", sizeof(RunObject), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION, run_slots,
};

#define RING_HEADER_BYTES 4096 /* `HEADER_BYTES` of imud/formats/ring.py */
#define RING_NEWEST_OFFSET 192
#define RING_FIRST_OFFSET 200
#define RING_HEARTBEAT_OFFSET 208
#define RING_LEDGER_OFFSET 256
#define RING_DRIVER_BYTES 32
#define RING_COUNTERS 59 /* `LEDGER_ROOM` of imud/formats/ring.py */

static void put_word(uint8_t *memory, uint64_t value)
{
    __atomic_store_n((uint64_t *)memory, value, __ATOMIC_RELEASE);
}

/* Ring of slots in the memory of a file. */
typedef struct {
    PyObject_HEAD
    Py_buffer memory;
    int64_t mask; /* number of slots - 1 */
    int64_t newest; /* sequence number of the newest slot */
    uint64_t update; /* number of changes of the ledger */
    int fd;
} RingObject;

/* Block of the ledger (`HEADER_FIELDS` of imud/formats/ring.py). */
typedef struct {
    uint64_t update;
    char driver[RING_DRIVER_BYTES];
    uint64_t counters[RING_COUNTERS];
    uint32_t crc32;
} LedgerBlock;

_Static_assert(offsetof(LedgerBlock, crc32) == 512, "a block of the ledger has no padding before its CRC-32");

static PyObject *ring_type;

/* open_ring(memory, mask, newest_seq, fd) -> Ring of mask + 1 slots */
static PyObject *open_ring(PyObject *self, PyObject *args)
{
    Py_buffer memory;
    int64_t mask, newest;
    int fd;
    if (!PyArg_ParseTuple(args, "w*LLi:open_ring", &memory, &mask, &newest, &fd))
        return NULL;
    RingObject *made = NULL;
    if (mask < 0 || mask > (INT64_C(1) << 32) || memory.len < RING_HEADER_BYTES + (mask + 1) * (int64_t)sizeof(Slot) ||
        (uintptr_t)memory.buf % sizeof(uint64_t))
        PyErr_SetString(PyExc_ValueError, "expected the memory of a ring of mask + 1 slots");
    else
        made = PyObject_New(RingObject, (PyTypeObject *)ring_type);
    if (made == NULL) {
        PyBuffer_Release(&memory);
        return NULL;
    }
    made->memory = memory;
    made->mask = mask;
    made->newest = newest;
    made->update = 0;
    made->fd = fd;
    return (PyObject *)made;
}

/* Ring.write(slots): write slots one after the other -> False without a change if the file is shorter than the memory */
static PyObject *write_ring(RingObject *self, PyObject *packed)
{
    char *slots;
    Py_ssize_t size;
    uint8_t *memory = self->memory.buf;
    if (PyBytes_AsStringAndSize(packed, &slots, &size) < 0)
        return NULL;
    if (lseek(self->fd, 0, SEEK_END) < self->memory.len)
        return PyBool_FromLong(0);
    for (; size >= (Py_ssize_t)sizeof(Slot); size -= (Py_ssize_t)sizeof(Slot), slots += sizeof(Slot)) {
        uint64_t seq;
        memcpy(&seq, slots, sizeof seq);
        uint8_t *slot = memory + RING_HEADER_BYTES + (seq & (uint64_t)self->mask) * sizeof(Slot);
        put_word(slot, UINT64_MAX); /* invalid while it changes */
        __atomic_thread_fence(__ATOMIC_SEQ_CST);
        uint32_t present, before;
        memcpy(&present, slots + offsetof(Slot, present), sizeof present);
        memcpy(&before, slot + offsetof(Slot, present), sizeof before);
        memcpy(slot + sizeof seq, slots + sizeof seq, MORE_OFFSET - sizeof seq);
        if ((present | before) & HAS_MORE) /* these bytes of other slots are 0 */
            memcpy(slot + MORE_OFFSET, slots + MORE_OFFSET, sizeof(Slot) - MORE_OFFSET);
        put_word(slot, seq);
        put_word(memory + RING_NEWEST_OFFSET, seq);
        if (seq != (uint64_t)self->newest + 1) /* the ring does not contain the samples between */
            put_word(memory + RING_FIRST_OFFSET, seq);
        self->newest = (int64_t)seq;
    }
    return PyBool_FromLong(1);
}

/* Ring.beat(now_ns): write the heartbeat -> False without a change if the file is shorter than the memory */
static PyObject *beat_ring(RingObject *self, PyObject *now)
{
    int64_t now_ns;
    if (!integer(now, &now_ns))
        return NULL;
    if (lseek(self->fd, 0, SEEK_END) < self->memory.len)
        return PyBool_FromLong(0);
    put_word((uint8_t *)self->memory.buf + RING_HEARTBEAT_OFFSET, (uint64_t)now_ns);
    return PyBool_FromLong(1);
}

/* Ring.show(driver, counters): write the ledger if it changed -> False without a change if the file is shorter than
 * the memory */
static PyObject *show_ledger(RingObject *self, PyObject *args)
{
    const char *driver;
    PyObject *counters;
    uint8_t *to = (uint8_t *)self->memory.buf + RING_LEDGER_OFFSET;
    LedgerBlock block = {.update = self->update + 1};
    if (!PyArg_ParseTuple(args, "sO!:show", &driver, &PyTuple_Type, &counters))
        return NULL;
    size_t size = strlen(driver);
    memcpy(block.driver, driver, size < RING_DRIVER_BYTES ? size : RING_DRIVER_BYTES - 1);
    Py_ssize_t count = PyTuple_Size(counters);
    if (count > RING_COUNTERS) {
        PyErr_Format(PyExc_ValueError, "expected at most %d counters, got %zd", RING_COUNTERS, count);
        return NULL;
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        block.counters[i] = PyLong_AsUnsignedLongLong(PyTuple_GetItem(counters, i));
        if (block.counters[i] == UINT64_MAX && PyErr_Occurred())
            return NULL;
    }
    if (lseek(self->fd, 0, SEEK_END) < self->memory.len)
        return PyBool_FromLong(0);
    const uint8_t *payload = (const uint8_t *)&block + sizeof block.update;
    size_t payload_bytes = offsetof(LedgerBlock, crc32) - sizeof block.update;
    if (self->update && !memcmp(to + sizeof block.update, payload, payload_bytes))
        return PyBool_FromLong(1);
    block.crc32 = crc32_of((const uint8_t *)&block, offsetof(LedgerBlock, crc32));
    put_word(to, UINT64_MAX); /* invalid while it changes */
    __atomic_thread_fence(__ATOMIC_SEQ_CST);
    memcpy(to + sizeof block.update, payload, payload_bytes + sizeof block.crc32);
    put_word(to, block.update);
    self->update = block.update;
    return PyBool_FromLong(1);
}

/* is_at(path, st_dev, st_ino) -> whether the path, as bytes, is this file and not a link to it */
static PyObject *is_at(PyObject *self, PyObject *args)
{
    const char *path;
    unsigned long long device, inode;
    /* lstat needs glibc 2.33, and its inode numbers have 32 bits on a 32-bit host */
    struct statx found;
    if (!PyArg_ParseTuple(args, "yKK:is_at", &path, &device, &inode))
        return NULL;
    return PyBool_FromLong(!statx(AT_FDCWD, path, AT_SYMLINK_NOFOLLOW, STATX_INO, &found) && found.stx_ino == inode &&
                           makedev(found.stx_dev_major, found.stx_dev_minor) == device);
}

static void free_ring(PyObject *self)
{
    PyTypeObject *type = Py_TYPE(self);
    PyBuffer_Release(&((RingObject *)self)->memory);
    PyObject_Free(self);
    Py_DECREF(type);
}

static PyMethodDef ring_methods[] = {
    {"write", (PyCFunction)write_ring, METH_O, "Write slots; return False if the file was truncated."},
    {"beat", (PyCFunction)beat_ring, METH_O, "Write the heartbeat; return False if the file was truncated."},
    {"show", (PyCFunction)show_ledger, METH_VARARGS, "Write the ledger; return False if the file was truncated."},
    {NULL, NULL, 0, NULL},
};

static PyMemberDef ring_members[] = {
    {"newest", T_LONGLONG, offsetof(RingObject, newest), READONLY, "sequence number of the newest slot"},
    {NULL, 0, 0, 0, NULL},
};

static PyType_Slot ring_slots[] = {
    {Py_tp_methods, ring_methods}, {Py_tp_members, ring_members}, {Py_tp_dealloc, (void *)free_ring}, {0, NULL},
};

static PyType_Spec ring_spec = {
    "imud._kernel.Ring", sizeof(RingObject), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION, ring_slots,
};

#define LATENCY_MOST_NS (INT64_C(1) << 50) /* 13 days; the sum of SLOTS_MOST latencies fits into 64 bits */
#define SLOTS_MOST 4096

/* add_latencies(buckets, bounds, slots, now_ns) -> status bits of the slots, sum of their latencies. Adds each latency
 * to the bucket of the first bound that it does not exceed. None without a change if Python must count. */
static PyObject *add_latencies(PyObject *self, PyObject *const *args, Py_ssize_t count)
{
    Py_buffer buckets;
    char *bounds, *slots;
    Py_ssize_t bounds_bytes, size;
    int64_t now_ns, sum_ns = 0, latency_ns, bound_ns, t_ns;
    uint32_t bits = 0, status;
    if (count != 4) {
        PyErr_Format(PyExc_TypeError, "add_latencies: expected 4 arguments, got %zd", count);
        return NULL;
    }
    if (PyBytes_AsStringAndSize(args[1], &bounds, &bounds_bytes) < 0 ||
        PyBytes_AsStringAndSize(args[2], &slots, &size) < 0 || !integer(args[3], &now_ns) ||
        PyObject_GetBuffer(args[0], &buckets, PyBUF_WRITABLE) < 0)
        return NULL;
    Py_ssize_t bucket = bounds_bytes / (Py_ssize_t)sizeof bound_ns, slot_count = size / (Py_ssize_t)sizeof(Slot);
    int is_usual = slot_count <= SLOTS_MOST && is_time(now_ns);
    if (buckets.len < bounds_bytes + (Py_ssize_t)sizeof(int64_t)) {
        PyErr_SetString(PyExc_ValueError, "add_latencies: expected a bucket more than bounds");
        is_usual = 0;
    }
    for (Py_ssize_t i = 0; is_usual && i < slot_count; i++) {
        memcpy(&t_ns, slots + i * (Py_ssize_t)sizeof(Slot) + offsetof(Slot, t_ns), sizeof t_ns);
        is_usual = is_time(t_ns) && llabs(now_ns - t_ns) <= LATENCY_MOST_NS;
    }
    for (Py_ssize_t i = 0; is_usual && i < slot_count; i++, slots += sizeof(Slot)) {
        memcpy(&t_ns, slots + offsetof(Slot, t_ns), sizeof t_ns);
        memcpy(&status, slots + offsetof(Slot, status), sizeof status);
        bits |= status;
        sum_ns += latency_ns = now_ns - t_ns;
        /* the time stamps rise, so that the latencies fall */
        for (; bucket > 0; bucket--) {
            memcpy(&bound_ns, bounds + (bucket - 1) * (Py_ssize_t)sizeof bound_ns, sizeof bound_ns);
            if (bound_ns < latency_ns)
                break;
        }
        ((int64_t *)buckets.buf)[bucket]++;
    }
    PyBuffer_Release(&buckets);
    if (PyErr_Occurred())
        return NULL;
    if (!is_usual)
        Py_RETURN_NONE;
    return Py_BuildValue("kL", (unsigned long)bits, (long long)sum_ns);
}

#define FRAME_HEADER_BYTES 4 /* size of the message, little-endian (`FRAME_HEADER` of imud/formats/jsonrpc.py) */

/* frame_slots(slots) -> the slots as messages of the socket, back to back */
static PyObject *frame_slots(PyObject *self, PyObject *packed)
{
    char *slots;
    Py_ssize_t size;
    const uint32_t slot_bytes = sizeof(Slot);
    if (PyBytes_AsStringAndSize(packed, &slots, &size) < 0)
        return NULL;
    Py_ssize_t count = size / (Py_ssize_t)sizeof(Slot);
    PyObject *framed = PyBytes_FromStringAndSize(NULL, count * (Py_ssize_t)(FRAME_HEADER_BYTES + sizeof(Slot)));
    if (framed == NULL)
        return NULL;
    char *to = PyBytes_AsString(framed);
    for (; count; count--, slots += sizeof(Slot), to += FRAME_HEADER_BYTES + sizeof(Slot)) {
        memcpy(to, &slot_bytes, FRAME_HEADER_BYTES);
        memcpy(to + FRAME_HEADER_BYTES, slots, sizeof(Slot));
    }
    return framed;
}

/* Samples of one second (`SECOND` of imud/publishers/socket/history.py). */
typedef struct {
    int64_t first_ns, last_ns, utc_ns, latency_ns;
    uint64_t seq;
    uint32_t count, t_err_ns, present;
    uint8_t sync, reserved[3];
    float low[12], high[12]; /* accel, gyro, mag, euler */
    float quat_wxyz[4], temperature_c, pressure_pa;
    uint32_t lost, gaps; /* Python counts them */
} Second;

_Static_assert(sizeof(Second) == 184, "a second has 184 bytes without padding");

/* Return whether each value is finite and fits into a float. */
static int fit_float(const double *values, int count)
{
    for (int i = 0; i < count; i++)
        if (!(fabs(values[i]) <= FLT_MAX))
            return 0;
    return 1;
}

static void add_range(Second *second, uint32_t bit, int first, const double *vector)
{
    float *low = second->low + first, *high = second->high + first;
    if (!fit_float(vector, 3))
        return;
    if (!(second->present & bit)) {
        second->present |= bit;
        for (int i = 0; i < 3; i++)
            low[i] = high[i] = (float)vector[i];
    }
    for (int i = 0; i < 3; i++) {
        float value = (float)vector[i];
        low[i] = value < low[i] ? value : low[i];
        high[i] = value > high[i] ? value : high[i];
    }
}

static void add_slot(Second *second, const Slot *slot)
{
    int64_t latency_ns;
    int is_first = !second->count;
    if (__builtin_sub_overflow(slot->t_rx_ns, slot->t_ns, &latency_ns))
        latency_ns = slot->t_ns < 0 ? INT64_MAX : INT64_MIN;
    if (is_first)
        second->first_ns = slot->t_ns;
    if (is_first || latency_ns > second->latency_ns)
        second->latency_ns = latency_ns;
    if (slot->t_err_ns > second->t_err_ns)
        second->t_err_ns = slot->t_err_ns;
    second->last_ns = slot->t_ns;
    second->utc_ns = slot->utc_ns;
    second->seq = slot->seq;
    second->sync = slot->sync;
    second->count++;
    if (slot->present & HAS_ACCEL)
        add_range(second, HAS_ACCEL, 0, slot->accel_m_s2);
    if (slot->present & HAS_GYRO)
        add_range(second, HAS_GYRO, 3, slot->gyro_rad_s);
    if (slot->present & HAS_MAG)
        add_range(second, HAS_MAG, 6, slot->mag_t);
    if (slot->present & HAS_EULER)
        add_range(second, HAS_EULER, 9, slot->euler_rad);
    if (slot->present & HAS_QUAT && fit_float(slot->quat_wxyz, 4)) {
        second->present |= HAS_QUAT;
        for (int i = 0; i < 4; i++)
            second->quat_wxyz[i] = (float)slot->quat_wxyz[i];
    }
    if (slot->present & HAS_TEMPERATURE && fit_float(&slot->temperature_c, 1)) {
        second->present |= HAS_TEMPERATURE;
        second->temperature_c = (float)slot->temperature_c;
    }
    if (slot->present & HAS_PRESSURE && fit_float(&slot->pressure_pa, 1)) {
        second->present |= HAS_PRESSURE;
        second->pressure_pa = (float)slot->pressure_pa;
    }
}

static int64_t second_of(int64_t t_ns)
{
    int64_t second = t_ns / 1000000000;
    return t_ns % 1000000000 < 0 ? second - 1 : second;
}

/* add_slots(second, slots, offset) -> offset of the first slot that is in another second, or the size of `slots` */
static PyObject *add_slots(PyObject *self, PyObject *args)
{
    Py_buffer open, slots;
    Py_ssize_t offset;
    if (!PyArg_ParseTuple(args, "w*y*n:add_slots", &open, &slots, &offset))
        return NULL;
    if (open.len != (Py_ssize_t)sizeof(Second) || offset < 0) {
        PyErr_SetString(PyExc_ValueError, "expected 184 bytes of a second and an offset of 0 or more");
    } else {
        Second second;
        Slot slot;
        int64_t number = 0;
        memcpy(&second, open.buf, sizeof second);
        if (second.count)
            number = second_of(second.first_ns);
        for (; slots.len - offset >= (Py_ssize_t)sizeof slot; offset += (Py_ssize_t)sizeof slot) {
            memcpy(&slot, (const char *)slots.buf + offset, offsetof(Slot, incli_rad));
            if (!second.count)
                number = second_of(slot.t_ns);
            else if (second_of(slot.t_ns) != number)
                break;
            add_slot(&second, &slot);
        }
        memcpy(open.buf, &second, sizeof second);
    }
    PyBuffer_Release(&open);
    PyBuffer_Release(&slots);
    return PyErr_Occurred() ? NULL : PyLong_FromSsize_t(offset);
}

#define CAN_FRAME_BYTES 72   /* `struct canfd_frame`: identifier with flags, length, data from byte 8 as in can_frame */
#define CAN_DATA_MOST 64
#define CAN_CONTROL_BYTES 64 /* control messages of a frame: arrival time, then number of dropped frames */
#define CAN_FRAMES_MOST 64   /* frames of a read: `BATCH_FRAMES` of imud/links/socketcan.py */
#define CAN_STAMP_AT (sizeof(size_t) + 4)
#define CAN_DROPS_AT (2 * sizeof(size_t) + 28)
#define CAN_NO_DATA 0x60000000u /* an error frame or a remote frame */
#define CAN_EXTENDED 0x80000000u
#define CAN_ID_MOST 0x1FFFFFFFu
#define CAN_BACKLOG_NS 5000000 /* `BACKLOG_NS` of imud/links/socketcan.py */
#define SO_TIMESTAMPNS_NEW 64
#define SO_RXQ_OVFL 40

/* receive(fd, raw, control) -> number of frames that recvmmsg(2) stored in the buffers; -errno if it failed. It never
 * blocks, so that it keeps the interpreter lock. */
static PyObject *receive(PyObject *self, PyObject *args)
{
    struct mmsghdr messages[CAN_FRAMES_MOST];
    struct iovec vectors[CAN_FRAMES_MOST];
    Py_buffer raw, control;
    int fd, count = 0;
    if (!PyArg_ParseTuple(args, "iw*w*:receive", &fd, &raw, &control))
        return NULL;
    Py_ssize_t most = raw.len / CAN_FRAME_BYTES;
    if (most > CAN_FRAMES_MOST || control.len / CAN_CONTROL_BYTES < most) {
        PyErr_SetString(PyExc_ValueError, "receive: expected buffers for at most 64 frames");
    } else {
        for (Py_ssize_t i = 0; i < most; i++) {
            vectors[i] = (struct iovec){(char *)raw.buf + i * CAN_FRAME_BYTES, CAN_FRAME_BYTES};
            messages[i].msg_hdr = (struct msghdr){
                .msg_iov = &vectors[i], .msg_iovlen = 1,
                .msg_control = (char *)control.buf + i * CAN_CONTROL_BYTES, .msg_controllen = CAN_CONTROL_BYTES,
            };
        }
        count = recvmmsg(fd, messages, (unsigned int)most, MSG_DONTWAIT, NULL);
        if (count < 0)
            count = -errno;
    }
    PyBuffer_Release(&raw);
    PyBuffer_Release(&control);
    return PyErr_Occurred() ? NULL : PyLong_FromLong(count);
}

/* Return the frame of a row as the class `frame_type`; NULL without an exception if Python must decode the row. */
static PyObject *can_frame(newfunc make, PyTypeObject *frame_type, const uint8_t *raw, const uint8_t *control,
                           uint32_t drops, int64_t offset_ns, int64_t stepped_ns, int64_t now_ns, int64_t *newest_ns)
{
    uint32_t can_id, row_drops;
    int32_t kind, drops_kind;
    int64_t seconds, ns;
    memcpy(&can_id, raw, 4);
    memcpy(&kind, control + CAN_STAMP_AT, 4);
    memcpy(&seconds, control + CAN_STAMP_AT + 4, 8);
    memcpy(&ns, control + CAN_STAMP_AT + 12, 8);
    memcpy(&drops_kind, control + CAN_DROPS_AT, 4);
    memcpy(&row_drops, control + CAN_DROPS_AT + 4, 4);
    if (can_id & CAN_NO_DATA || kind != SO_TIMESTAMPNS_NEW || (drops_kind == SO_RXQ_OVFL && row_drops != drops) ||
        seconds < 0 || seconds > INT64_C(4000000000) || ns < 0 || ns >= 1000000000)
        return NULL;
    int64_t t_ns = seconds * 1000000000 + ns - offset_ns;
    if (stepped_ns && !(*newest_ns < t_ns && t_ns <= now_ns) && *newest_ns < t_ns + stepped_ns &&
        t_ns + stepped_ns <= now_ns)
        t_ns += stepped_ns;
    if (t_ns > *newest_ns)
        *newest_ns = t_ns;
    else if (t_ns < *newest_ns - CAN_BACKLOG_NS)
        *newest_ns = now_ns;
    if (*newest_ns > now_ns)
        *newest_ns = now_ns;
    PyObject *args = Py_BuildValue("((kONLO))", (unsigned long)(can_id & CAN_ID_MOST),
                                   can_id & CAN_EXTENDED ? Py_True : Py_False,
                                   PyBytes_FromStringAndSize((const char *)raw + 8, Py_MIN(raw[4], CAN_DATA_MOST)),
                                   (long long)*newest_ns, Py_False);
    PyObject *made = args == NULL ? NULL : make(frame_type, args, NULL);
    Py_XDECREF(args);
    return made;
}

/* can_frames(frame_type, raw, control, count, drops, offset_ns, stepped_ns, now_ns, newest_ns) -> the frames; None if
 * Python must decode them, because one is not a data frame, follows a loss, or has no arrival time */
static PyObject *can_frames(PyObject *self, PyObject *args)
{
    PyObject *frame_type, *frames = NULL;
    Py_buffer raw, control;
    Py_ssize_t count;
    unsigned int drops;
    long long offset_ns, stepped_ns, now_ns, newest;
    if (!PyArg_ParseTuple(args, "O!y*y*nILLLL:can_frames", &PyType_Type, &frame_type, &raw, &control, &count, &drops,
                          &offset_ns, &stepped_ns, &now_ns, &newest))
        return NULL;
    int64_t newest_ns = newest;
    if (count < 0 || count > raw.len / CAN_FRAME_BYTES || count > control.len / CAN_CONTROL_BYTES)
        PyErr_SetString(PyExc_ValueError, "can_frames: expected buffers for count frames");
    else if (!PyType_IsSubtype((PyTypeObject *)frame_type, &PyTuple_Type))
        PyErr_SetString(PyExc_TypeError, "can_frames: expected a class of tuples");
    else if (is_time(offset_ns / 2) && is_time(stepped_ns) && is_time(now_ns) && is_time(newest))
        frames = PyList_New(count);
    newfunc make = (newfunc)PyType_GetSlot(&PyTuple_Type, Py_tp_new);
    for (Py_ssize_t i = 0; frames != NULL && i < count; i++) {
        PyObject *frame = can_frame(make, (PyTypeObject *)frame_type, (const uint8_t *)raw.buf + i * CAN_FRAME_BYTES,
                                    (const uint8_t *)control.buf + i * CAN_CONTROL_BYTES, drops, offset_ns, stepped_ns,
                                    now_ns, &newest_ns);
        if (frame == NULL)
            Py_CLEAR(frames);
        else
            PyList_SetItem(frames, i, frame);
    }
    PyBuffer_Release(&raw);
    PyBuffer_Release(&control);
    if (frames == NULL && !PyErr_Occurred())
        Py_RETURN_NONE;
    return frames;
}

#define RULE_ORDER 4              /* `ORDER` of imud/publishers/rules/limit.py */
#define RULE_AXES 3
#define RULE_PERIOD_NS 1000000000 /* `PERIOD_NS`, `STEP_MAX_NS` */
#define RULE_PERIOD_STEPS 16
#define RULE_LATE_MAX 16
#define RULE_GAP_PERIODS 1.5
#define RULE_PERIOD_CHANGE 0.05

enum { MAGNITUDE, SIGNED, TILT, INTEGER }; /* `Reduction` */
enum { OF_SAMPLE, PEAK, RMS };             /* `Statistic` */
enum { UNCHANGED, BEGIN, END, PERIOD };    /* `Change` */

/* `LimitState` of imud/publishers/rules/limit.py */
typedef struct {
    double above, below, above_end, below_end, scale, value, period_ns, peak, peak_before;
    int64_t hold_ns, end_hold_ns, window_ns, settle_ns, last_ns, held_ns, begin_ns, number, measured_ns, measured, late,
        filter_ns, used, absent, not_finite, evaluated, restarts;
    uint32_t bit;
    uint16_t offset;
    uint8_t count, reduction, statistic, has_band, designed, active, change, is_old, is_filtering, has_window;
    double sums[RULE_AXES], squares[RULE_AXES], gains[RULE_ORDER], a1[RULE_ORDER], a2[RULE_ORDER];
    double memory[RULE_AXES][RULE_ORDER][2];
} Limit;

_Static_assert(sizeof(Limit) == 560, "a limit has 560 bytes without padding");

static int are_finite(const double *values, int count)
{
    for (int i = 0; i < count; i++)
        if (!isfinite(values[i]))
            return 0;
    return 1;
}

static int follow_period(Limit *limit, int64_t t_ns, int64_t step_ns)
{
    if (limit->period_ns > 0 && (double)step_ns > RULE_GAP_PERIODS * limit->period_ns) {
        limit->measured_ns = t_ns;
        limit->measured = limit->is_filtering = 0;
        limit->restarts++;
        if (++limit->late >= RULE_LATE_MAX) {
            limit->period_ns = 0;
            limit->designed = 0;
            limit->late = 0;
        }
        return 0;
    }
    limit->late = 0;
    limit->measured += step_ns > 0;
    if (limit->measured < RULE_PERIOD_STEPS || t_ns - limit->measured_ns < RULE_PERIOD_NS)
        return 0;
    double mean_ns = (double)(t_ns - limit->measured_ns) / (double)limit->measured;
    limit->measured_ns = t_ns;
    limit->measured = 0;
    if (limit->period_ns > 0 && fabs(mean_ns - limit->period_ns) <= RULE_PERIOD_CHANGE * limit->period_ns)
        return 0;
    limit->period_ns = mean_ns;
    limit->designed = 0;
    return 1;
}

static void filter(Limit *limit, int64_t t_ns, double *x)
{
    if (!limit->is_filtering) {
        limit->is_filtering = 1;
        limit->filter_ns = t_ns;
        limit->has_window = 0;
        limit->held_ns = -1;
        memset(limit->memory, 0, sizeof limit->memory);
        for (int axis = 0; axis < limit->count; axis++)
            limit->memory[axis][0][0] = limit->memory[axis][0][1] = -(limit->gains[0] * x[axis]);
    }
    for (int axis = 0; axis < limit->count; axis++) {
        double value = x[axis];
        for (int i = 0; i < RULE_ORDER; i++) {
            double *memory = limit->memory[axis][i], fed = limit->gains[i] * value;
            value = fed + memory[0];
            memory[0] = memory[1] - limit->a1[i] * value;
            memory[1] = -fed - limit->a2[i] * value;
        }
        x[axis] = value;
    }
}

/* Return whether a window is complete; its RMS is then in `value`. */
static int add_to_rms(Limit *limit, int64_t t_ns, int64_t step_ns, const double *x)
{
    if (limit->has_window && step_ns >= limit->window_ns)
        limit->has_window = 0;
    if (!limit->has_window)
        limit->value = INFINITY;
    if (!limit->has_window || t_ns - limit->begin_ns >= limit->window_ns) {
        if (limit->has_window) {
            double total = 0.0;
            for (int axis = 0; axis < RULE_AXES; axis++) {
                double mean = limit->has_band ? 0.0 : limit->sums[axis] / (double)limit->number;
                double square = limit->squares[axis] / (double)limit->number - mean * mean;
                total += 0.0 > square ? 0.0 : square;
            }
            limit->value = limit->scale * sqrt(total);
        }
        limit->begin_ns = t_ns;
        limit->number = 0;
        limit->has_window = 1;
        memset(limit->sums, 0, sizeof limit->sums);
        memset(limit->squares, 0, sizeof limit->squares);
    }
    limit->number++;
    for (int axis = 0; axis < limit->count; axis++) {
        limit->sums[axis] += x[axis];
        limit->squares[axis] += x[axis] * x[axis];
    }
    return limit->value != INFINITY;
}

/* Return the value of a sample, or the peak of its windows. */
static double value_of(Limit *limit, int64_t t_ns, const double *x)
{
    double value;
    if (limit->reduction == TILT)
        value = limit->scale * acos(cos(x[0]) * cos(x[1]));
    else if (limit->reduction != MAGNITUDE)
        value = limit->scale * x[0];
    else if (limit->count == 1)
        value = limit->scale * fabs(x[0]);
    else
        value = limit->scale * sqrt((x[0] * x[0] + x[1] * x[1]) + x[2] * x[2]);
    if (limit->statistic == OF_SAMPLE || !isfinite(value))
        return value;
    if (!limit->has_window || t_ns - limit->begin_ns >= limit->window_ns) {
        limit->peak_before = limit->has_window && t_ns - limit->begin_ns < 2 * limit->window_ns ? limit->peak : 0.0;
        limit->peak = value;
        limit->begin_ns = t_ns;
        limit->has_window = 1;
    } else if (value > limit->peak) {
        limit->peak = value;
    }
    return limit->peak > limit->peak_before ? limit->peak : limit->peak_before;
}

static int compare(Limit *limit, double value, int64_t step_ns)
{
    limit->value = value;
    limit->evaluated++;
    int is_new_side = limit->active ? value <= limit->above_end && value >= limit->below_end
                                    : value > limit->above || value < limit->below;
    if (!is_new_side) {
        limit->held_ns = -1;
        return UNCHANGED;
    }
    if (limit->held_ns < 0)
        limit->held_ns = 0;
    else
        limit->held_ns += step_ns < RULE_PERIOD_NS ? step_ns : RULE_PERIOD_NS;
    if (limit->held_ns < (limit->active ? limit->end_hold_ns : limit->hold_ns))
        return UNCHANGED;
    limit->active = !limit->active;
    limit->held_ns = -1;
    return limit->active ? BEGIN : END;
}

static int add_to_limit(Limit *limit, const char *slot)
{
    int64_t t_ns, step_ns = 0;
    uint32_t present, integer;
    double x[RULE_AXES];
    memcpy(&t_ns, slot + offsetof(Slot, t_ns), sizeof t_ns);
    memcpy(&present, slot + offsetof(Slot, present), sizeof present);
    if (limit->bit && !(present & limit->bit)) {
        limit->absent++;
        return UNCHANGED;
    }
    if (limit->reduction == INTEGER) {
        memcpy(&integer, slot + limit->offset, sizeof integer);
        x[0] = integer;
    } else {
        memcpy(x, slot + limit->offset, limit->count * sizeof x[0]);
    }
    if (!are_finite(x, limit->count) || !is_time(t_ns)) {
        limit->not_finite++;
        limit->is_filtering = 0;
        return UNCHANGED;
    }
    if (limit->is_old)
        step_ns = t_ns - limit->last_ns;
    if (!limit->is_old || step_ns < 0) {
        limit->is_old = 1;
        limit->measured_ns = t_ns;
        limit->measured = limit->late = limit->is_filtering = limit->has_window = 0;
        limit->held_ns = -1;
        step_ns = 0;
    }
    limit->last_ns = t_ns;
    limit->used++;
    if (limit->has_band) {
        if (follow_period(limit, t_ns, step_ns))
            return PERIOD;
        if (!limit->designed)
            return UNCHANGED;
        filter(limit, t_ns, x);
        if (!are_finite(x, limit->count)) {
            limit->not_finite++;
            limit->is_filtering = 0;
            return UNCHANGED;
        }
        if (t_ns - limit->filter_ns < limit->settle_ns)
            return UNCHANGED;
    }
    double value;
    if (limit->statistic != RMS)
        value = value_of(limit, t_ns, x);
    else if (add_to_rms(limit, t_ns, step_ns, x))
        value = limit->value;
    else
        return UNCHANGED;
    if (!isfinite(value)) {
        limit->not_finite++;
        return UNCHANGED;
    }
    return compare(limit, value, step_ns);
}

/* evaluate(limit, slots, offset) -> offset after the first slot with a change; -1 if no slot has one */
static PyObject *evaluate(PyObject *self, PyObject *const *args, Py_ssize_t count)
{
    Py_buffer state;
    char *slots;
    Py_ssize_t size, offset, end = -1;
    Limit limit;
    if (count != 3) {
        PyErr_Format(PyExc_TypeError, "evaluate: expected 3 arguments, got %zd", count);
        return NULL;
    }
    offset = PyLong_AsSsize_t(args[2]);
    if ((offset == -1 && PyErr_Occurred()) || PyBytes_AsStringAndSize(args[1], &slots, &size) < 0 ||
        PyObject_GetBuffer(args[0], &state, PyBUF_WRITABLE) < 0)
        return NULL;
    if (state.len == (Py_ssize_t)sizeof limit)
        memcpy(&limit, state.buf, sizeof limit);
    if (state.len != (Py_ssize_t)sizeof limit || offset < 0 || limit.count > RULE_AXES ||
        limit.offset > sizeof(Slot) - sizeof(double) * RULE_AXES) {
        PyErr_SetString(PyExc_ValueError, "expected 560 bytes of a limit and an offset of 0 or more");
    } else {
        for (; end < 0 && size - offset >= (Py_ssize_t)sizeof(Slot); offset += (Py_ssize_t)sizeof(Slot))
            if ((limit.change = (uint8_t)add_to_limit(&limit, slots + offset)) != UNCHANGED)
                end = offset + (Py_ssize_t)sizeof(Slot);
        memcpy(state.buf, &limit, sizeof limit);
    }
    PyBuffer_Release(&state);
    return PyErr_Occurred() ? NULL : PyLong_FromSsize_t(end);
}

static PyMethodDef methods[] = {
    {"evaluate", (PyCFunction)(void (*)(void))evaluate, METH_FASTCALL,
     "Evaluate slots up to the first change of a limit; return the offset after its slot, or -1."},
    {"receive", receive, METH_VARARGS, "Receive CAN frames by recvmmsg."},
    {"can_frames", can_frames, METH_VARARGS, "Return CAN frames of the buffers of recvmmsg; or None."},
    {"add_latencies", (PyCFunction)(void (*)(void))add_latencies, METH_FASTCALL,
     "Add the latencies of slots to the buckets of a meter; return their status bits and the sum, or None."},
    {"add_slots", add_slots, METH_VARARGS, "Add slots to the minimum and maximum of a second."},
    {"frame_slots", frame_slots, METH_O, "Return slots as messages of the socket, back to back."},
    {"is_at", is_at, METH_VARARGS, "Return whether a path is a file."},
    {"open_ring", open_ring, METH_VARARGS, "Return a Ring in the memory of a file."},
    {"start", start, METH_VARARGS, "Return a Run for frames of a format that starts with a state; or None."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "imud._kernel", NULL, 0, methods, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__kernel(void)
{
    make_tables();
    if (run_type == NULL && (run_type = PyType_FromSpec(&run_spec)) == NULL)
        return NULL;
    if (ring_type == NULL && (ring_type = PyType_FromSpec(&ring_spec)) == NULL)
        return NULL;
    PyObject *made = PyModule_Create(&module);
    PyObject *source_crc = PyLong_FromUnsignedLong(SOURCE_CRC);
    if (made == NULL || PyModule_AddObjectRef(made, "source_crc", source_crc) < 0)
        Py_CLEAR(made);
    Py_XDECREF(source_crc);
    return made;
}
