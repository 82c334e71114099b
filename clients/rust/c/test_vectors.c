/* The test vectors through the C interface, and what the interface promises about errors.
 * Usage: test_vectors FOLDER, the folder of docs/protocol/vectors. */
#include "dehyst.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define MAX_ROWS 256
#define ROOM 65536

static int failures = 0;

#define CHECK(condition, ...)                                                                                          \
    do {                                                                                                               \
        if (!(condition)) {                                                                                            \
            failures++;                                                                                                \
            printf("%s:%d: %s: ", __FILE__, __LINE__, #condition);                                                     \
            printf(__VA_ARGS__);                                                                                       \
            printf("\n");                                                                                              \
        }                                                                                                              \
    } while (0)

typedef struct {
    char name[64], model[80], query[80], reply[80], continues[64];
    dehyst_limits limits;
    double age_s;
} row;

typedef struct {
    uint8_t *bytes;
    size_t length;
} payload;

static payload load(const char *folder, const char *name) {
    char path[1024];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    FILE *file = fopen(path, "rb");
    if (!file) {
        printf("%s: cannot be read\n", path);
        exit(2);
    }
    payload got = {malloc(1 << 20), 0};
    got.length = fread(got.bytes, 1, 1 << 20, file);
    fclose(file);
    return got;
}

static uint32_t u32_at(const uint8_t *at) {
    uint32_t value;
    memcpy(&value, at, 4);
    return value;
}

static double f64_at(const uint8_t *at) {
    double value;
    memcpy(&value, at, 8);
    return value;
}

static void same(const char *name, const char *what, size_t i, double got, double expected) {
    int close = fabs(got - expected) <= 1e-12 * fmax(1.0, fabs(expected)) || (isnan(got) && isnan(expected));
    CHECK(close, "%s %s[%zu]: got %.17g, expected %.17g", name, what, i, got, expected);
}

/* Every query by its bytes. */
static void query_case(const char *folder, const row *c) {
    payload model = load(folder, c->model), query = load(folder, c->query), expected = load(folder, c->reply);
    static uint8_t reply[ROOM];
    size_t length = 0;
    dehyst *handle = NULL;
    CHECK(dehyst_open_payload(model.bytes, model.length, &c->limits, &handle) == 0, "%s", dehyst_error());
    CHECK(dehyst_query(handle, query.bytes, query.length, c->age_s, reply, ROOM, &length) == 0, "%s", dehyst_error());
    CHECK(length == expected.length, "%s: %zu bytes, expected %zu", c->name, length, expected.length);
    if (length == expected.length) {
        uint32_t n = u32_at(reply + 4), m = u32_at(reply + 16);
        size_t doubles = 2 * (size_t)n + m, end = 24 + 8 * doubles;
        CHECK(memcmp(reply, expected.bytes, 24) == 0, "%s: header", c->name);
        for (size_t i = 0; i < doubles; i++)
            same(c->name, "doubles", i, f64_at(reply + 24 + 8 * i), f64_at(expected.bytes + 24 + 8 * i));
        CHECK(memcmp(reply + end, expected.bytes + end, length - end) == 0, "%s: flags or name", c->name);
    }
    dehyst_close(handle);
    free(model.bytes), free(query.bytes), free(expected.bytes);
}

/* The cases that continue each other, by points and blocks of one handle. */
static int follow(const char *folder, const row *rows, size_t count) {
    dehyst *handle = NULL;
    char model_now[80] = "";
    int followed = 0;
    for (size_t r = 0; r < count; r++) {
        const row *c = &rows[r];
        if (strncmp(c->name, "follow-", 7) != 0)
            continue;
        payload model = load(folder, c->model), query = load(folder, c->query), expected = load(folder, c->reply);
        if (!handle) {
            CHECK(dehyst_open_payload(model.bytes, model.length, &c->limits, &handle) == 0, "%s", dehyst_error());
        } else if (strcmp(model_now, c->model) != 0) {
            CHECK(dehyst_update(handle, model.bytes, model.length) == 0, "%s", dehyst_error());
        }
        snprintf(model_now, sizeof model_now, "%s", c->model);
        uint32_t n = u32_at(query.bytes + 4), m = u32_at(query.bytes + 24);
        double y[64], v[64], a[64], u[64], std[64], memory[256];
        uint8_t flags[64];
        for (uint32_t i = 0; i < n; i++) {
            y[i] = f64_at(query.bytes + 32 + 8 * (m + i));
            v[i] = f64_at(query.bytes + 32 + 8 * (m + n + i));
            a[i] = f64_at(query.bytes + 32 + 8 * (m + 2 * n + i));
        }
        if (n == 1) {
            dehyst_answer answer;
            CHECK(dehyst_point(handle, y[0], v[0], a[0], &answer) == 0, "%s", dehyst_error());
            u[0] = answer.u_V, std[0] = answer.std_V, flags[0] = (uint8_t)answer.flags;
        } else {
            CHECK(dehyst_block(handle, n, y, v, a, u, std, flags) == 0, "%s", dehyst_error());
        }
        m = u32_at(expected.bytes + 16);
        CHECK(dehyst_memory(handle, memory, 256) == 0, "%s", dehyst_error());
        for (uint32_t i = 0; i < n; i++) {
            same(c->name, "u_V", i, u[i], f64_at(expected.bytes + 24 + 8 * i));
            same(c->name, "std_V", i, std[i], f64_at(expected.bytes + 24 + 8 * (n + i)));
            CHECK(flags[i] == expected.bytes[24 + 8 * (2 * n + m) + i], "%s: flags of point %u", c->name, i);
        }
        for (uint32_t i = 0; i < m; i++)
            same(c->name, "memory", i, memory[i], f64_at(expected.bytes + 24 + 8 * (2 * n + i)));
        followed++;
        free(model.bytes), free(query.bytes), free(expected.bytes);
    }
    dehyst_report_t report;
    CHECK(dehyst_report(handle, &report) == 0, "%s", dehyst_error());
    CHECK(report.answered > 90 && report.received == 4 && report.refused == 0, "report");
    CHECK(report.dt_s == 1e-3 && report.memory_size == 44, "report");
    CHECK(strcmp(report.source, "lssvm_adaptive") == 0, "got: %s", report.source);
    CHECK(report.gain == 1.0 && report.last.u_V > 0.0 && report.age_s >= 0.0 && report.trust == 1.0, "report");
    dehyst_close(handle);
    return followed;
}

/* Whole models and changes in order: what dehyst_update says, and the answers after each. */
static int changes(const char *folder, const dehyst_limits *limits) {
    char path[1024], line[256], name[64], message[16], name_of_file[80], outcome[16], base[16];
    long long seq;
    snprintf(path, sizeof path, "%s/deltas.txt", folder);
    FILE *file = fopen(path, "r");
    CHECK(file != NULL, "%s", path);
    dehyst *handle = NULL;
    payload query = load(folder, "deltas.query.payload");
    int steps = 0;
    while (file && fgets(line, sizeof line, file)) {
        if (sscanf(line, "%63s %15s %79s %15s %15s %lld", name, message, name_of_file, outcome, base, &seq) != 6 ||
            name[0] == '#')
            continue;
        payload got = load(folder, name_of_file);
        if (!handle) {
            CHECK(dehyst_open_payload(got.bytes, got.length, limits, &handle) == 0, "%s", dehyst_error());
        } else {
            int expected = !strcmp(outcome, "lost") ? DEHYST_WHOLE_NEEDED : !strcmp(outcome, "refused") ? -1 : 0;
            int status = dehyst_update(handle, got.bytes, got.length);
            CHECK(status == expected, "%s: got %d, expected %d", name, status, expected);
        }
        snprintf(path, sizeof path, "%s/deltas-%s.reply.payload", folder, name);
        FILE *exists = fopen(path, "rb");
        if (exists) {
            fclose(exists);
            snprintf(path, sizeof path, "deltas-%s.reply.payload", name);
            payload expected = load(folder, path);
            static uint8_t reply[ROOM];
            size_t length = 0;
            CHECK(dehyst_query(handle, query.bytes, query.length, NAN, reply, ROOM, &length) == 0, "%s", dehyst_error());
            CHECK(length == expected.length, "%s: %zu bytes, expected %zu", name, length, expected.length);
            for (size_t i = 0; length == expected.length && i < 2 * (size_t)u32_at(reply + 4); i++)
                same(name, "doubles", i, f64_at(reply + 24 + 8 * i), f64_at(expected.bytes + 24 + 8 * i));
            free(expected.bytes);
        }
        free(got.bytes);
        steps++;
    }
    if (file)
        fclose(file);
    dehyst_close(handle);
    free(query.bytes);
    return steps;
}

/* Wrong use is refused with a text, and changes nothing. */
static void refusals(const char *folder, const row *c) {
    payload model = load(folder, c->model);
    dehyst *handle = NULL;
    dehyst_answer answer = {0, 0, 0}, again = {1, 1, 1};
    dehyst_limits swapped = {10.0, 0.0, 1.0, 0.0, 1.0};
    CHECK(dehyst_open_payload(model.bytes, model.length - 8, &c->limits, &handle) == -1, "a cut payload");
    CHECK(strstr(dehyst_error(), "payload") && !handle, "got: %s", dehyst_error());
    CHECK(dehyst_open_payload(model.bytes, model.length, &swapped, &handle) == -1, "swapped limits");
    CHECK(dehyst_open_payload(NULL, 40, &c->limits, &handle) == -1, "no payload");
    CHECK(dehyst_open_payload(model.bytes, model.length, NULL, &handle) == -1, "no limits");
    CHECK(dehyst_open_payload(model.bytes, model.length, &c->limits, &handle) == 0, "%s", dehyst_error());
    CHECK(dehyst_point(handle, 40.0, NAN, 0.0, &answer) == -1 && strstr(dehyst_error(), "v_um_per_s"), "NaN");
    CHECK(dehyst_point(handle, 1e9, 0.0, 0.0, &answer) == -1 && strstr(dehyst_error(), "y_um"), "out of range");
    CHECK(dehyst_point(NULL, 40.0, 0.0, 0.0, &answer) == -1, "no handle");
    CHECK(dehyst_update(handle, model.bytes, 30) == -1, "a cut update");
    CHECK(dehyst_point(handle, 40.0, 0.0, 0.0, &answer) == 0 && answer.flags == 0, "%s", dehyst_error());
    CHECK(dehyst_start(handle, NAN) == 0 && dehyst_point(handle, 40.0, 0.0, 0.0, &again) == 0, "%s", dehyst_error());
    CHECK(answer.u_V == again.u_V, "start goes back to the memory of the payload: %g %g", answer.u_V, again.u_V);
    CHECK(dehyst_start(handle, NAN) == 0 && dehyst_warm(handle, 40.0, 0.0, 0.0) == 0, "%s", dehyst_error());
    CHECK(dehyst_point(handle, 40.0, 0.0, 0.0, &again) == 0 && answer.u_V == again.u_V, "a warm start moves nothing");
    CHECK(dehyst_warm(handle, NAN, 0.0, 0.0) == -1 && strstr(dehyst_error(), "y_um"), "NaN");
    dehyst_report_t report;
    CHECK(dehyst_report(handle, &report) == 0 && report.refused == 1 && report.received == 1, "counts");
    dehyst_close(handle);
    dehyst_close(NULL);
    free(model.bytes);
}

/* What a follower that corrects gives, point after point; returns the number of points. */
static int corrections(const char *folder, const char *table, const dehyst_limits *limits) {
    char path[1024], line[1024], model[80], change[80], read_seq[32], period_s[32];
    snprintf(path, sizeof path, "%s/%s", folder, table);
    FILE *file = fopen(path, "r");
    dehyst_correction integral, repetition;
    CHECK(file && fgets(line, sizeof line, file) &&
              sscanf(line, "# %79s %lf %lf %lf %lf %lf %lf", model, &integral.share, &integral.mode_Hz, &integral.fade_s,
                     &repetition.share, &repetition.mode_Hz, &repetition.fade_s) == 7,
          "%s", table);
    if (!file)
        return 0;
    int repeats = !isnan(repetition.share);
    payload first = load(folder, model);
    dehyst *handle = NULL;
    CHECK(dehyst_open_payload(first.bytes, first.length, limits, &handle) == 0, "%s", dehyst_error());
    CHECK(dehyst_corrected(handle, 1, NULL) == -1 && strstr(dehyst_error(), "dehyst_correct"), "no correction yet");
    dehyst_correction bad = integral;
    bad.mode_Hz = 0.0;
    CHECK(dehyst_correct(handle, &bad, NULL) == -1 && strstr(dehyst_error(), "correction.mode_Hz"), "a mode of 0 Hz");
    CHECK(dehyst_correct(handle, NULL, &bad) == -1 && strstr(dehyst_error(), "repetition.mode_Hz"), "a mode of 0 Hz");
    CHECK(dehyst_correct(handle, &integral, repeats ? &repetition : NULL) == 0, "%s", dehyst_error());
    CHECK(dehyst_number(handle, -1) == -1 && dehyst_number(NULL, 1) == -1, "a number below 0, no handle");
    CHECK(dehyst_period(handle, 1e9) == -1 && dehyst_period(NULL, 0.1) == -1, "a period of 1e9 s, no handle");
    int checked = 0;
    while (fgets(line, sizeof line, file)) {
        double y, v, read_um, u_V, integral_V, repetition_V, period;
        long long seq, age;
        unsigned long long halved, doubted, halved_too, doubted_too;
        unsigned active;
        if (line[0] == '#')
            continue;
        int got = sscanf(line, "%lld %lf %lf %79s %31s %31s %lf %lf %lld %lf %llu %llu %lf %llu %llu %lf %u", &seq, &y, &v,
                         change, period_s, read_seq, &read_um, &u_V, &age, &integral_V, &halved, &doubted, &repetition_V,
                         &halved_too, &doubted_too, &period, &active);
        CHECK(got == 17, "%s: %s", table, line);
        if (strcmp(change, "-")) {
            payload other = load(folder, change);
            CHECK(dehyst_update(handle, other.bytes, other.length) == 0, "%s", dehyst_error());
            free(other.bytes);
        }
        if (strcmp(period_s, "-"))
            CHECK(dehyst_period(handle, atof(period_s)) == 0, "%s", dehyst_error());
        if (strcmp(read_seq, "-")) {
            int64_t number = atoll(read_seq);
            CHECK(dehyst_read(handle, 1, &number, &read_um) == 0, "%s", dehyst_error());
        }
        dehyst_answer answer;
        dehyst_corrected_t state;
        CHECK(dehyst_number(handle, seq) == 0 && dehyst_point(handle, y, v, 0.0, &answer) == 0, "%s", dehyst_error());
        CHECK(dehyst_corrected(handle, 1, &state) == 0, "%s", dehyst_error());
        same(table, "u_V", (size_t)seq, answer.u_V, u_V);
        same(table, "integral_V", (size_t)seq, state.integral.u_V, integral_V);
        same(table, "repetition_V", (size_t)seq, state.repetition.u_V, repetition_V);
        same(table, "period", (size_t)seq, state.period, period);
        CHECK(state.age == age && state.active == active, "%s: state at %lld", table, seq);
        CHECK(state.integral.halved == halved && state.integral.doubted == doubted, "%s: integral at %lld", table, seq);
        CHECK(state.repetition.halved == halved_too && state.repetition.doubted == doubted_too,
              "%s: repetition at %lld", table, seq);
        checked++;
    }
    fclose(file);
    dehyst_close(handle);
    free(first.bytes);
    return checked;
}

int main(int argc, char **argv) {
    if (argc != 2) {
        printf("usage: test_vectors FOLDER\n");
        return 2;
    }
    static row rows[MAX_ROWS];
    size_t count = 0;
    char path[1024], line[1024];
    snprintf(path, sizeof path, "%s/cases.txt", argv[1]);
    FILE *file = fopen(path, "r");
    if (!file) {
        printf("%s: cannot be read\n", path);
        return 2;
    }
    while (count < MAX_ROWS && fgets(line, sizeof line, file)) {
        row *c = &rows[count];
        if (line[0] == '#')
            continue;
        int got = sscanf(line, "%63s %79s %79s %79s %63s %lf %lf %lf %lf %lf %lf", c->name, c->model, c->query,
                         c->reply, c->continues, &c->limits.u_min_V, &c->limits.u_max_V, &c->limits.slew_V_per_s,
                         &c->limits.y_min_um, &c->limits.y_max_um, &c->age_s);
        CHECK(got == 11, "cases.txt: %s", line);
        count++;
    }
    fclose(file);
    CHECK(dehyst_version() == 1, "version");
    for (size_t i = 0; i < count; i++)
        query_case(argv[1], &rows[i]);
    int followed = follow(argv[1], rows, count);
    CHECK(count > 50 && followed == 9, "%zu cases, %d followed", count, followed);
    int steps = changes(argv[1], &rows[0].limits);
    CHECK(steps > 10, "%d steps of changes", steps);
    refusals(argv[1], &rows[0]);
    CHECK(corrections(argv[1], "correction.txt", &rows[0].limits) >= 1000, "correction.txt");
    CHECK(corrections(argv[1], "repetition.txt", &rows[0].limits) >= 1000, "repetition.txt");
    printf("C: %zu queries, %d followed blocks, %d steps of changes: %d failures\n", count, followed, steps, failures);
    return failures ? 1 : 0;
}
