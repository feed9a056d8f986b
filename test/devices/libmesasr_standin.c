/* Stands in for the vendor's library libmesasr in tests: the functions that the driver uses, with the signatures of
 * the public header, and a camera that is a formula. It shares no code with the vendor's library and speaks to
 * no hardware.
 *
 * The file named by RIM_STANDIN_CONTROL is read at every call that matters; lines are "key value":
 *   plugged   1 or 0
 *   fault     none; hang, crash, short, fail, null_image: of acquisition and images;
 *             hang_open, crash_open, none_open: of opening; refuse: every change of the modulation frequency
 *   period_us duration of an acquisition
 *   count     a file that grows by a byte with every acquisition
 *   rows, columns, version (four numbers with dots), ids (vendor:product, hexadecimal), stuck_mode (bits)
 *
 * Row v, column u, integration register n, number of the modulation frequency f, mode bits m, with threshold t:
 *   amplitude = 2000 + 10 n + 3 u + 5 v + 1000 m;  distance = 1000 + 131 v + 7 u + 64 f, 0 where amplitude < t
 */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

struct control {
    int plugged, period_us, rows, columns, stuck_mode;
    unsigned version[4], vendor, product;
    char fault[32], count[256];
};

struct camera {
    int rows, columns, mode, frequency, automatic;
    unsigned char integration, least, greatest;
    unsigned short threshold;
    uint16_t *distance, *amplitude;
};

static struct control read_control(void) {
    struct control c = {1, 2000, 144, 176, 0, {1, 0, 14, 747}, 0x1ad2, 0x0074, "none", ""};
    const char *path = getenv("RIM_STANDIN_CONTROL");
    FILE *file = path ? fopen(path, "r") : NULL;
    char key[32], value[256];
    if (!file)
        return c;
    while (fscanf(file, "%31s %255s", key, value) == 2) {
        if (!strcmp(key, "plugged")) c.plugged = atoi(value);
        else if (!strcmp(key, "fault")) snprintf(c.fault, sizeof c.fault, "%.31s", value);
        else if (!strcmp(key, "count")) snprintf(c.count, sizeof c.count, "%s", value);
        else if (!strcmp(key, "period_us")) c.period_us = atoi(value);
        else if (!strcmp(key, "rows")) c.rows = atoi(value);
        else if (!strcmp(key, "columns")) c.columns = atoi(value);
        else if (!strcmp(key, "stuck_mode")) c.stuck_mode = atoi(value);
        else if (!strcmp(key, "ids")) sscanf(value, "%x:%x", &c.vendor, &c.product);
        else if (!strcmp(key, "version"))
            sscanf(value, "%u.%u.%u.%u", &c.version[0], &c.version[1], &c.version[2], &c.version[3]);
    }
    fclose(file);
    return c;
}

static int is(const struct control *c, const char *fault) { return !strcmp(c->fault, fault); }

static void hang(void) {
    for (;;)
        pause();
}

int SR_GetVersion(unsigned short version[4]) {
    struct control c = read_control();
    for (int i = 0; i < 4; i++)
        version[i] = (unsigned short)c.version[3 - i];
    return 0;
}

int SR_OpenUSB(struct camera **opened, unsigned int serial) {
    struct control c = read_control();
    if (is(&c, "hang_open")) hang();
    if (is(&c, "crash_open")) abort();
    if (!c.plugged || is(&c, "none_open") || (serial && serial != 0x4000002f))
        return 0;
    struct camera *camera = calloc(1, sizeof *camera);
    camera->rows = c.rows;
    camera->columns = c.columns;
    camera->mode = 0x05; /* the vendor's default is not raw */
    camera->frequency = 3;
    camera->integration = 90;
    camera->distance = calloc((size_t)c.rows * c.columns, 2);
    camera->amplitude = calloc((size_t)c.rows * c.columns, 2);
    *opened = camera;
    puts("stand-in for libmesasr: a library that writes to standard output");
    fflush(stdout);
    return 1;
}

int SR_Close(struct camera *camera) {
    free(camera->distance);
    free(camera->amplitude);
    free(camera);
    return 0;
}

int SR_GetDeviceString(struct camera *camera, char *text, int size) {
    struct control c = read_control();
    (void)camera;
    return snprintf(text, (size_t)size, "VendorID:0x%04x, ProductID:0x%04x, Manufacturer:'stand-in', Product:'%s'",
                    c.vendor, c.product, "formula");
}

unsigned int SR_ReadSerial(struct camera *camera) { (void)camera; return 0x4000002f; }
void SR_SetTimeout(struct camera *camera, int milliseconds) { (void)camera; (void)milliseconds; }
unsigned int SR_GetRows(struct camera *camera) { return (unsigned)camera->rows; }
unsigned int SR_GetCols(struct camera *camera) { return (unsigned)camera->columns; }

int SR_SetMode(struct camera *camera, int mode) {
    camera->mode = mode | read_control().stuck_mode;
    return 0;
}
int SR_GetMode(struct camera *camera) { return camera->mode; }

int SR_SetIntegrationTime(struct camera *camera, unsigned char value) {
    camera->integration = value;
    return 2;
}
unsigned char SR_GetIntegrationTime(struct camera *camera) { return camera->integration; }

int SR_SetAmplitudeThreshold(struct camera *camera, unsigned short value) {
    camera->threshold = value;
    return 4;
}
unsigned short SR_GetAmplitudeThreshold(struct camera *camera) { return camera->threshold; }

int SR_SetModulationFrequency(struct camera *camera, int number) {
    struct control c = read_control();
    if (is(&c, "refuse")) return -7;
    camera->frequency = number;
    return 0;
}
int SR_GetModulationFrequency(struct camera *camera) { return camera->frequency; }

int SR_SetAutoExposure(struct camera *camera, unsigned char least, unsigned char greatest, unsigned char percent,
                       unsigned char position) {
    (void)percent;
    (void)position;
    camera->automatic = least != 0xff;
    camera->least = least;
    camera->greatest = greatest;
    if (camera->automatic)
        camera->integration = least;
    return 0;
}

int SR_Acquire(struct camera *camera) {
    struct control c = read_control();
    usleep((useconds_t)c.period_us);
    if (is(&c, "hang")) hang();
    if (is(&c, "crash")) abort();
    if (!c.plugged || is(&c, "fail")) return -1;
    for (int v = 0; v < camera->rows; v++)
        for (int u = 0; u < camera->columns; u++) {
            int amplitude = 2000 + 10 * camera->integration + 3 * u + 5 * v + 1000 * camera->mode;
            int distance = 1000 + 131 * v + 7 * u + 64 * camera->frequency;
            camera->amplitude[v * camera->columns + u] = (uint16_t)amplitude;
            camera->distance[v * camera->columns + u] = amplitude < camera->threshold ? 0 : (uint16_t)distance;
        }
    FILE *count = c.count[0] ? fopen(c.count, "a") : NULL;
    if (count) {
        fputc('.', count);
        fclose(count);
    }
    if (camera->automatic && camera->integration < camera->greatest)
        camera->integration++; /* for the next exposure */
    return (is(&c, "short") ? 3 : 4) * camera->rows * camera->columns;
}

void *SR_GetImage(struct camera *camera, unsigned char index) {
    struct control c = read_control();
    if (is(&c, "null_image")) return NULL;
    return index == 0 ? camera->distance : index == 1 ? camera->amplitude : NULL;
}
